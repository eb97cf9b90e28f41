"""What the arm's own controller says, and what a person has it do; there where the arm has one."""

from __future__ import annotations

import viser

from common import topics
from common.messages import RobotCommand, RobotStatus
from page import words
from page.console import Console
from page.markup import block, fields, span

ACTS = {"Enable": "enable", "Recover": "recover"}
PATIENCE = 35.0  # [s] wall: joints are powered, and brakes released


class ArmPanel:
    """Shows whether the arm can be moved, and why it cannot; its buttons power it and have it recover."""

    def __init__(self, gui: viser.GuiApi, console: Console) -> None:
        """Lay the panel out where the GUI stands; it is not seen until the arm tells something."""
        self._console = console
        self._folder = gui.add_folder("Controller of the arm", visible=False)
        with self._folder:
            buttons = gui.add_button_group(
                "Have it", tuple(ACTS), hint="power and brakes; go on after a stop for safety: look why it stopped")
            console.on_choice(buttons, self._act)
            self._state = gui.add_html("")

    def show(self, robot: RobotStatus | None) -> None:
        """Show how the arm is, as it says itself."""
        tells = robot is not None and robot.controller
        if tells != self._folder.visible:
            self._folder.visible = tells
        if robot is None or not tells:
            return
        word, kind = words.arm_mode(robot)
        lines = [f'<div>{span("●", kind + " dot")} {span(word, "big")}</div>']
        if robot.message:
            lines.append(f"<div>{span(robot.message, kind)}</div>")
        lines.append(fields({"slider": f"{robot.speed:.0%}", "latest cycle": f"{robot.late * 1e3:.0f} ms"}))
        content = block("".join(lines), "robot", mode=robot.mode)
        if content != self._state.content:
            self._state.content = content

    async def _act(self, chosen: str) -> None:
        order = RobotCommand.model_validate({
            "header": self._console.header(), "act": ACTS[chosen], "owner": self._console.doors.person})
        self._console.tell(f"{chosen}: asked", "busy")
        answer = await self._console.ask(topics.ROBOT_COMMAND, order, PATIENCE)
        self._console.tell(f"{chosen}: {words.arm_mode(answer)[0].lower()}", "good")
