"""The panel that is always there: stop, what the task does, and what a person tells it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import viser

from common.errors import RemoteError, ZencellError
from common.messages import MotionStatus, TaskStatus
from common.viewer import words
from common.viewer.console import SLIDING, Console, assign
from common.viewer.markup import STYLE, block, fields, span, text
from common.viewer.words import problem

COMMANDS = ("Start", "Pause", "Resume")
SLOWEST = 5  # [%]
# viser has no large button: the one after the mark is made so, and kept in sight.
STOP_STYLE = """<style>
div:has(> div > .zc-stop) + div { position: sticky; top: 0; z-index: 10; }
div:has(> .zc-stop) + div { position: sticky; top: 0; z-index: 10; }
div:has(> div > .zc-stop) + div button, div:has(> .zc-stop) + div button {
  height: 3.2em !important; font-size: 1.05em; font-weight: 700; letter-spacing: 0.12em; }
</style><div class="zc-stop"></div>"""


class TaskPanel:
    """Shows the task and takes orders for it."""

    def __init__(
        self, gui: viser.GuiApi, console: Console, told: words.TaskWords,
        home: Callable[[], Coroutine[Any, Any, None]],
    ) -> None:
        """Lay the panel out in the main panel.

        Args:
            gui: of the server.
            console: takes the orders and carries them out.
            told: words for the task.
            home: has the arm go home.
        """
        self._console, self._words = console, told
        self._refused = ""  # command that was, because another person holds the arm
        self._speed_told = self._speed_heard = 100  # [%]
        gui.add_html(STYLE + STOP_STYLE)
        stop = gui.add_button("STOP", color="red", icon=viser.Icon.HAND_STOP)
        console.on_click(stop, self._stop, "stop")
        hotkey = gui.add_command("Stop the arm and the task", hotkey="escape", icon=viser.Icon.HAND_STOP)

        async def pressed(_event: object) -> None:
            console.put(self._stop)

        console.doors.need(hotkey._impl.uuid, "stop", "STOP")
        hotkey.on_trigger(pressed)
        console.on_choice(gui.add_button_group("Task", COMMANDS), self._command)
        console.on_choice(gui.add_button_group("Arm", ("Go home",)), lambda _: home())
        if console.doors.guarded:
            take = gui.add_button("Take over", hint="one at a time moves the arm; STOP is for everybody")
            console.on_click(take, lambda: self.tell("You operate", "good"), "take")
        self._speed = gui.add_slider("Speed [%]", SLOWEST, 100, 5, 100, hint="share of the planned speed, at once")
        console.on_change(self._speed, self._set_speed)
        # Below all that is pressed: lines come and go here, and a button that moves away under the pointer is missed.
        self._state = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0)
        self._notice = gui.add_html("")

    def tell(self, line: str, kind: str = "bad") -> None:
        """Show a line about what a person asked for; an empty one takes it away."""
        self._notice.content = block(span(line, kind), "notice", kind=kind) if line else ""

    def show(self, task: TaskStatus | None, motion: MotionStatus | None, gripper: str, rejected: int) -> None:
        """Show how the task is doing.

        Args:
            task: what it says of itself.
            motion: what the arm does.
            gripper: what the fingers do, in words.
            rejected: places that cannot be taken.
        """
        word, kind = self._words.state(task)
        lines = [f'<div>{span("●", kind + " dot")} {span(word, "big")}</div>']
        if task is not None and task.stage and task.state not in ("DONE", "ERROR"):
            lines.append(f"<div>{span('Step:', 'dim')} {text(task.stage.replace('_', ' '))}</div>")
        if task is not None and task.message:
            lines.append(f"<div>{span(task.message, 'bad' if task.state == 'ERROR' else 'dim')}</div>")
        lines.append(f"<div>{span('Arm:', 'dim')} {text(words.motion(motion))} · {text(gripper)}</div>")
        if self._console.doors.guarded:
            lines.append(f"<div>{span('Operates:', 'dim')} {text(self._console.doors.operator or 'nobody')}</div>")
        for one in motion.inhibits if motion is not None else ():
            if task is None or one.told not in task.message:
                lines.append(f"<div>{span(one.told, 'dim')}</div>")
        if task is not None:
            lines.append(fields(self._words.counters(task, rejected)))
        state = task.state if task else ""
        held = motion.held if motion else False
        content = block("".join(lines), "task", state=state, paused=bool(task and task.paused), held=held)
        if content != self._state.content:
            self._state.content = content
        assign(self._progress, round(100 * self._words.done(task, motion), 1))
        if motion is not None and (percent := round(100 * motion.speed_scaling)) != self._speed_heard:
            self._speed_heard = self._speed_told = percent  # what a person is just setting is heard of when it is set
            assign(self._speed, max(SLOWEST, percent))

    async def _stop(self) -> None:
        await self._console.stop()
        self.tell("Stopped", "busy")

    async def _command(self, chosen: str) -> None:
        if chosen in COMMANDS:
            self.tell("")
            override, self._refused = chosen == self._refused, ""
            try:
                await self._console.command(chosen.lower(), override)
            except RemoteError as error:
                if error.code != "held":
                    raise
                self._refused = chosen
                self.tell(f"{problem(error)}: press {chosen} again for that")

    async def _set_speed(self, percent: float) -> None:
        self._speed_told = round(percent)
        await asyncio.sleep(SLIDING)
        if self._speed_told == round(percent):  # the slider came to rest there
            try:
                await self._console.set_speed(percent / 100)
            except ZencellError:
                assign(self._speed, max(SLOWEST, self._speed_heard))
                raise
