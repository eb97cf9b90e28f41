"""The panel on which parameters of running services are changed; made from what the services say of themselves."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from typing import Any

import viser
import yaml
from pydantic import JsonValue, TypeAdapter

from common.config import parse_yaml
from common.errors import ConfigError
from common.messages import Parameter
from page.console import SLIDING, Console, assign
from page.markup import block, span
from page.words import UNDERSTOOD, problem

SLIDER_STEPS = 200  # at least; a slider that moves coarser than a quarter of the value is of no use
COARSE = 10  # a slider's step about a value of 0
TYPING = 0.8  # [s] after the last letter a text or number is sent

_JSON: TypeAdapter[JsonValue] = TypeAdapter(JsonValue)
HINT = "What may change while the cell runs. ● is no longer what the cell was started with."


class TuningPanel:
    """A folder of knobs for each service and each section of the cell that has parameters that may change."""

    def __init__(
        self, gui: viser.GuiApi, tab: viser.GuiTabHandle | viser.GuiFolderHandle, console: Console
    ) -> None:
        """Lay the panel out in a tab; the console takes the changes and carries them out."""
        self._gui, self._tab, self._console = gui, tab, console
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
        self._console.on_change(knob.handle, lambda value: self._turn(knob, value), "tune")
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
            await self._console.set_parameter(knob.services, path, given)
        except UNDERSTOOD as error:
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


class Knob:
    """What one parameter is turned with: a slider, tick, list, number or text, made from its description.

    Attributes:
        parameter: as it was heard of last.
        services: that have it.
        turned: how often the person changed it.
        pending: whether what the person gave is still on its way.
    """

    def __init__(self, gui: viser.GuiApi, parameter: Parameter, services: list[str]) -> None:
        """Put it where the GUI stands."""
        self.parameter = parameter
        self.services = services
        self.turned = 0
        self.pending = False
        self.as_text = False
        self._label = label_of(parameter)
        self.handle = self._make(gui, f"{parameter.description or self._label} ({parameter.path})")
        immediate = isinstance(self.handle, viser.GuiCheckboxHandle | viser.GuiDropdownHandle)
        self.patience = 0.0 if immediate else SLIDING if isinstance(self.handle, viser.GuiSliderHandle) else TYPING
        self._mark()

    def _make(self, gui: viser.GuiApi, hint: str) -> viser.GuiInputHandle[Any]:
        p, value = self.parameter, self.parameter.value
        if p.type == "boolean" and isinstance(value, bool):
            return gui.add_checkbox(self._label, value, hint=hint)
        if p.choices and value in p.choices:
            return gui.add_dropdown(self._label, p.choices, initial_value=str(value), hint=hint)
        if p.type in ("number", "integer") and isinstance(value, int | float):
            whole = p.type == "integer"
            number: Any = int if whole else float
            low, high = (None if bound is None else number(bound) for bound in (p.minimum, p.maximum))
            step = step_of(p)
            if (low is not None and value < low) or (high is not None and value > high):
                low = high = step = None  # its service must know
            if low is not None and high is not None and step is not None:
                return gui.add_slider(self._label, low, high, number(step), number(value), hint=hint)
            return gui.add_number(self._label, number(value), min=low, max=high, step=1 if whole else None, hint=hint)
        self.as_text = p.type != "string" or not isinstance(value, str)
        return gui.add_text(self._label, self._text(value), hint=hint)

    def _text(self, value: JsonValue) -> str:
        if not self.as_text:
            return str(value)
        text = str(yaml.safe_dump(value, default_flow_style=True, width=10_000))
        return text.removesuffix("\n").removesuffix("\n...")

    def read(self, given: Any) -> JsonValue:
        """The value that was given with it.

        Raises:
            ConfigError: a text that cannot be read.
        """
        if not self.as_text:
            return given  # type: ignore[no-any-return]
        try:
            value: JsonValue = _JSON.validate_python(parse_yaml(given))
        except (yaml.YAMLError, ValueError):  # a date there never was is a ValueError
            raise ConfigError(self.parameter.path, given, "is not a YAML value") from None
        return value

    def show(self, parameter: Parameter) -> None:
        """Show the value that a parameter has now, unless the person is just changing it."""
        self.parameter = parameter
        if self.pending:
            return
        value = self._text(parameter.value) if isinstance(self.handle, viser.GuiTextHandle) else parameter.value
        if value is not None and value != self.handle.value:
            assign(self.handle, value)
        self._mark()

    def _mark(self) -> None:
        label = f"● {self._label}" if self.parameter.changed else self._label
        if self.handle.label != label:
            self.handle.label = label

    def fits(self, parameter: Parameter) -> bool:
        """Whether it can show that parameter; else another has to be made."""
        return _form(self.parameter) == _form(parameter)


def _form(p: Parameter) -> tuple[object, ...]:
    """What of a parameter decides what it is turned with."""
    kind = "number" if isinstance(p.value, int | float) and not isinstance(p.value, bool) else type(p.value).__name__
    return p.path, p.type, p.minimum, p.maximum, p.choices, kind, p.choices and p.value in p.choices


def label_of(parameter: Parameter) -> str:
    """What a parameter is called on the page: the end of its path in words, and the unit."""
    parts = parameter.path.split(".")
    name = " ".join(parts[2:] if parts[0] == "services" else parts[1:]).replace("_", " ")
    return f"{name} [{parameter.unit}]" if parameter.unit else name


def group_of(parameter: Parameter) -> str:
    """Under which heading a parameter stands: its service, or its section of the cell."""
    parts = parameter.path.split(".")
    return parts[1] if parts[0] == "services" else parts[0]


def step_of(parameter: Parameter) -> float | None:
    """A round step for a slider between the bounds; None when a slider would be too coarse or there are no bounds."""
    if parameter.minimum is None or parameter.maximum is None or parameter.maximum <= parameter.minimum:
        return None
    step = 10 ** math.floor(math.log10((parameter.maximum - parameter.minimum) / SLIDER_STEPS))
    if parameter.type == "integer":
        step = max(1, step)
    sizes = [abs(v) for v in (parameter.value, parameter.default)
             if isinstance(v, int | float) and not isinstance(v, bool) and v]
    fine = step <= min(sizes) / 4 if sizes else step <= COARSE
    return step if fine or parameter.type == "integer" else None
