"""Conveyor belts on the page."""

from __future__ import annotations

import re
from typing import Any

import viser

from common import topics
from common.messages import BeltState, ConveyorSet, ConveyorState, Header
from page.belt_panel import BeltPanel
from page.console import ActionQueue


async def test_belt_is_shown_and_switched(gui: viser.GuiApi) -> None:
    requests: list[ConveyorSet] = []
    state: list[ConveyorState] = []

    async def call(_request: Any, message: ConveyorSet) -> ConveyorState:
        requests.append(message)
        return state[0]

    console: Any = ActionQueue()
    console.latest = lambda topic: state[0] if topic is topics.CONVEYOR_STATE and state else None
    console.is_available = lambda _request: bool(state)
    console.header, console.acknowledged, console.call = Header, 7, call
    panel = BeltPanel(gui, console, ["belt"])

    def shown(disabled: str = "") -> str:
        panel.show(disabled)
        content = panel._html.content
        return " ".join(re.sub(r"<[^>]*>", " ", content).split()) + (" (off)" if "aria-disabled" in content else "")

    assert shown() == "belt ? Start the drive of the belts does not respond (off)"
    state.append(ConveyorState(belts=[BeltState(name="belt", speed=0.1, position=3.25, running=True, blocked=True)]))
    assert shown("the task controls the arm") == "belt 0.100 m/s, at 3.25 m light barrier blocked Stop"
    await console._buttons["belt:belt:False"][0]()
    assert (requests[0].running, requests[0].name, requests[0].acknowledged) == (False, "belt", 7)
    state[0] = ConveyorState(belts=[BeltState(name="belt")])
    assert shown("the task controls the arm") == "belt 0.000 m/s, at 0.00 m Start (off)"
