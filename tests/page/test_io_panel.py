"""Inputs and outputs on the page."""

from __future__ import annotations

import re
from typing import Any

import viser

from common import topics
from common.config import Io
from common.messages import Header, IoReply, IoSet, IoSignal, IoState
from page.console import ActionQueue
from page.io_panel import IoPanel

IO = Io.model_validate({"signals": {
    "clamp": {"output": 0}, "closed": {"input": 0}, "pressure": {"input": 1, "range": [0, 10], "unit": "bar"},
    "valve": {"output": 1, "range": [0, 1]}}})


class Cell:
    """The console of a cell whose service answers every request."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self.requests: list[IoSet] = []
        self.state: IoState | None = None
        self.console: Any = ActionQueue()
        self.console.latest = lambda topic: self.state if topic is topics.IO_STATE else None
        self.console.is_available = lambda _request: self.state is not None
        self.console.header, self.console.acknowledged, self.console.call = Header, 7, self.call
        self.panel = IoPanel(gui, self.console, IO)

    async def call(self, _request: Any, message: IoSet) -> IoReply:
        self.requests.append(message)
        return IoReply(signal=message.signal, value=message.value)

    def shown(self, disabled: str = "") -> dict[str, str]:
        """Return the row of each signal without tags, and its buttons with their state."""
        self.panel.show(disabled)
        rows = re.findall(r'<tr data-io="(\w+)">(.*?)</tr>', self.panel._html.content)
        return {name: " ".join(re.sub(r"<[^>]*>", " ", cells).split()) + (
            " (disabled)" if "aria-disabled" in cells else "") for name, cells in rows}


async def test_values_are_shown_and_an_output_is_switched(gui: viser.GuiApi) -> None:
    cell = Cell(gui)
    assert cell.shown()["clamp"] == "clamp out ? Switch on (disabled)"
    values: dict[str, Any] = {"clamp": False, "closed": True, "pressure": 4.5, "valve": 0.25}
    cell.state = IoState(signals=[IoSignal(name=name, direction="output" if IO.signals[name].is_output else "input",
                                           value=value) for name, value in values.items()])
    assert cell.shown() == {"clamp": "clamp out off Switch on", "closed": "closed in on",
                            "pressure": "pressure in 4.5 bar", "valve": "valve out 0.25"}
    assert cell.shown("the task controls the arm")["clamp"] == "clamp out off Switch on (disabled)"
    await cell.console._buttons["io:clamp:True"][0]()
    (request,) = cell.requests
    assert (request.signal, request.value, request.acknowledged) == ("clamp", True, 7)
    cell.state = cell.state.model_copy(update={"reason": "no answer within 1 s"})
    assert cell.shown()["clamp"].endswith("(disabled)") and "no answer within 1 s" in cell.panel._html.content
