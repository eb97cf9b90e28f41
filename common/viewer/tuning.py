"""The panel on which parameters of running services are changed; made from what the services say of themselves."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import viser

from common.errors import ZencellError
from common.messages import Parameter
from common.viewer.desk import Desk
from common.viewer.knobs import Knob, group_of
from common.viewer.markup import block, span
from common.viewer.requests import Requests
from common.viewer.words import problem

HINT = "What may change while the cell runs. ● is no longer what the cell was started with."


class TuningPanel:
    """A folder of knobs for each service and each section of the cell that has parameters that may change."""

    def __init__(
        self, gui: viser.GuiApi, tab: viser.GuiTabHandle | viser.GuiFolderHandle, desk: Desk, requests: Requests
    ) -> None:
        """Lay the panel out in a tab.

        Args:
            gui: of the server.
            tab: that knobs are put into.
            desk: takes the changes.
            requests: carry them out.
        """
        self._gui, self._tab, self._desk, self._requests = gui, tab, desk, requests
        self._knobs: dict[str, Knob] = {}
        self._folders: dict[str, viser.GuiFolderHandle] = {}
        with tab:
            self._note = gui.add_html("")
        self._tell(HINT, "dim")

    def show(self, found: Mapping[str, list[Parameter]]) -> None:
        """Show the parameters that the services have now, by service; those of a service that is silent stay."""
        services: dict[str, list[str]] = {}
        parameters: dict[str, Parameter] = {}
        for service, listed in found.items():
            for parameter in listed:
                if parameter.runtime:
                    services.setdefault(parameter.path, []).append(service)
                    parameters.setdefault(parameter.path, parameter)
        for path, parameter in parameters.items():
            knob = self._knobs.get(path)
            if knob is not None and knob.fits(parameter):
                knob.services = services[path]
                knob.show(parameter)
                continue
            if knob is not None:
                knob.handle.remove()
            self._knobs[path] = self._new(parameter, services[path])

    def _new(self, parameter: Parameter, services: list[str]) -> Knob:
        group = group_of(parameter)
        if group not in self._folders:
            with self._tab:
                self._folders[group] = self._gui.add_folder(group.replace("_", " "), expand_by_default=False)
        with self._folders[group]:
            knob = Knob(self._gui, parameter, services)
        self._desk.on_change(knob.handle, lambda value: self._turn(knob, value))
        return knob

    async def _turn(self, knob: Knob, value: Any) -> None:
        """Send a value once the person has let go of it."""
        knob.turned += 1
        turned, knob.pending = knob.turned, True
        await asyncio.sleep(knob.patience)
        if turned != knob.turned:
            return
        path = knob.parameter.path
        try:
            given = knob.read(value)
            await self._requests.set_parameter(knob.services, path, given)
        except ZencellError as error:
            self._tell(problem(error), "bad")
            if turned == knob.turned:
                knob.pending = False
                knob.show(knob.parameter)
            return
        self._tell(f"{path} is {given} now", "good")
        if turned == knob.turned:
            knob.pending = False
            knob.parameter = knob.parameter.model_copy(update={"value": given})

    def _tell(self, line: str, kind: str) -> None:
        self._note.content = block(span(line, kind), "tuning", kind=kind)
