"""The fingers, as a person moves them: open, close, to a width, with a force."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import viser

from common import topics
from common.config import check
from common.messages import GripperCommand, MotionStatus
from common.time_source import new_id
from page.markup import block, buttons, press, text

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from common.config import GripperConfig
    from page.console import Console


class HandPanel:
    """Buttons for the fingers."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, gripper: GripperConfig,
        free: Callable[[], Awaitable[MotionStatus]],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            console: takes the orders.
            gripper: what the robot file says of it.
            free: returns when the arm is nobody else's, and raises if it is.
        """
        self._console, self._free, self._gripper = console, free, gripper
        self._width, self._force = 1e3 * gripper.max_width, gripper.effort
        widest = round(self._width, 1)
        width = gui.add_number("Width [mm]", widest, min=0.0, max=widest, step=0.1)
        force = gui.add_number("Force [N]", round(self._force, 1), min=0.0, max=gripper.max_effort, step=0.1)
        console.on_change(width, self._set_width)
        console.on_change(force, self._set_force)
        for name, target in (("open", lambda: 1e3 * gripper.max_width), ("close", lambda: 0.0),
                             ("width", lambda: self._width)):
            console.on_press(f"hand:{name}", self._moving(name, target), f"fingers: {name}")
        self._why = "?"
        self._html = gui.add_html("")

    def show(self, why: str) -> None:
        """Have the buttons off for a reason, or on without one."""
        if why != self._why:
            self._why = why
            self._html.content = block(buttons(
                *(press(label, f"hand:{name}", why, arm=True) for label, name in
                  (("Open", "open"), ("Close", "close"), ("To width", "width"))), label="Fingers")
                + (f'<div class="dim small">{text(why)}</div>' if why else ""), "hand")

    def _moving(self, name: str, width: Callable[[], float]) -> Callable[[], Any]:
        async def move() -> None:
            acknowledged = (await self._free()).newest
            asked = check(GripperCommand, {
                "header": self._console.header(), "acknowledged": acknowledged,
                "id": f"page-{new_id()}", "owner": self._console.doors.person,
                "width": width() * 1e-3, "effort": self._force}, "gripper")
            self._console.tell(f"Fingers: {name} …", "busy")
            state = await self._console.ask(topics.GRIPPER_COMMAND, asked)
            if state.state == "rejected":
                self._console.tell(f"Fingers: refused: {state.message}")
            else:
                self._console.tell(f"Fingers: {name}", "good")

        return move

    def _set_width(self, width: float) -> None:
        self._width = min(max(width, 0.0), 1e3 * self._gripper.max_width)

    def _set_force(self, force: float) -> None:
        self._force = min(max(force, 0.0), self._gripper.max_effort)
