"""Inputs and outputs in the Move tab: names, values, and a switch for each digital output."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from common import topics
from common.client.io import format_value
from common.config import Io, check
from common.messages import IoSet
from common.time_source import new_id
from page.console import Console
from page.markup import Html, block, press, row, span, table, text


class IoPanel:
    """A table of all signals. The rules for switching are those of motion: the service checks owner and interlocks."""

    def __init__(self, gui: viser.GuiApi, console: Console, io: Io) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            console: sends the requests.
            io: signals of the cell.
        """
        self._console, self._io = console, io
        self._html = Html(gui)
        for name in io.outputs:
            if io.signals[name].range is None:
                for value in (True, False):
                    console.on_press(f"io:{name}:{value}", self._switch(name, value), f"{name} {format_value(value)}")

    def show(self, disabled: str) -> None:
        """Update values and switches; `disabled` is why no operator may switch now."""
        available = self._console.is_available(topics.IO_SET)
        state = self._console.latest(topics.IO_STATE) if available else None
        problem = "the I/O service does not respond" if state is None else state.reason
        rows = []
        for name, signal in self._io.signals.items():
            known = state.find(name) if state is not None else None
            why = problem or (known.reason if known is not None else "")
            value = span(format_value(known.value if known is not None else None, signal.unit), "bad" if why else "big")
            switch = ""
            if signal.is_output and signal.range is None:
                wanted = not (known is not None and known.value is True)
                switch = press(f"Switch {format_value(wanted)}", f"io:{name}:{wanted}", disabled or why, arm=True)
            rows.append(row(text(name), "out" if signal.is_output else "in", value, switch, io=name))
        lost = span(problem, "bad") if problem else ""
        self._html.set(block(table((), rows) + lost, "io", signals=len(rows)))

    def _switch(self, name: str, value: bool) -> Callable[[], Any]:
        async def switch() -> None:
            request = check(IoSet, {
                "header": self._console.header(), "acknowledged": self._console.acknowledged, "id": f"page-{new_id()}",
                "owner": self._console.permissions.client_name, "signal": name, "value": value}, "io")
            reply = await self._console.call(topics.IO_SET, request)
            self._console.notify(f"{name}: {format_value(reply.value)}", "good")

        return switch
