"""The panel that is always there: stop, what the task does, and what a person tells it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import viser

from common.applications.outlining.messages import Contours, OutlineSelect, OutlineStatus
from common.errors import ZencellError
from common.messages import MotionStatus, TaskStatus
from common.viewer import words
from common.viewer.desk import Desk, assign
from common.viewer.knobs import SLIDING
from common.viewer.markup import STYLE, block, fields, span, text
from common.viewer.requests import Requests

COMMANDS = ("Start", "Pause", "Resume")
LARGEST = "Largest"
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

    def __init__(self, gui: viser.GuiApi, desk: Desk, requests: Requests, *, outlines: bool, home: Callable[
        [], Coroutine[Any, Any, None]]) -> None:
        """Lay the panel out in the main panel.

        Args:
            gui: of the server.
            desk: takes the orders.
            requests: carry them out.
            outlines: whether objects are chosen in this cell.
            home: has the arm go home.
        """
        self._gui, self._desk, self._requests = gui, desk, requests
        self._speed_told = self._speed_heard = 100  # [%]
        self._contours: list[str] = []
        gui.add_html(STYLE + STOP_STYLE)
        stop = gui.add_button("STOP", color="red", icon=viser.Icon.HAND_STOP)
        desk.on_click(stop, self._stop)
        hotkey = gui.add_command("Stop the arm and the task", hotkey="escape", icon=viser.Icon.HAND_STOP)

        async def pressed(_event: object) -> None:
            desk.put(self._stop)

        hotkey.on_trigger(pressed)
        self._state = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0)
        self._notice = gui.add_html("")
        desk.on_choice(gui.add_button_group("Task", COMMANDS), self._command)
        desk.on_choice(gui.add_button_group("Arm", ("Go home",)), lambda _: home())
        self._speed = gui.add_slider("Speed [%]", SLOWEST, 100, 5, 100, hint="share of the planned speed, at once")
        desk.on_change(self._speed, self._set_speed)
        self._choices: viser.GuiButtonGroupHandle | None = None
        if outlines:
            self._choices = gui.add_button_group("Outline", (LARGEST,), hint="choose an object: it is traced")
            desk.on_choice(self._choices, self._choose)

    def tell(self, line: str, kind: str = "bad") -> None:
        """Show a line about what a person asked for; an empty one takes it away."""
        self._notice.content = block(span(line, kind), "notice", kind=kind) if line else ""

    def show(self, task: TaskStatus | None, motion: MotionStatus | None, gripper: str, rejected: int) -> None:
        """Show how the task is doing.

        Args:
            task: what it says of itself.
            motion: what the arm does.
            gripper: what the fingers do, in words.
            rejected: places that can not be taken.
        """
        word, kind = words.task_state(task)
        lines = [f'<div>{span("●", kind + " dot")} {span(word, "big")}</div>']
        if task is not None and task.stage and task.state not in ("DONE", "ERROR"):
            lines.append(f"<div>{span('Step:', 'dim')} {text(task.stage.replace('_', ' '))}</div>")
        if task is not None and task.message:
            lines.append(f"<div>{span(task.message, 'bad' if task.state == 'ERROR' else 'dim')}</div>")
        lines.append(f"<div>{span('Arm:', 'dim')} {text(words.motion(motion))} · {text(gripper)}</div>")
        lines.append(fields(words.counters(task, rejected)))
        state = task.state if task else ""
        held = motion.held if motion else False
        content = block("".join(lines), "task", state=state, paused=bool(task and task.paused), held=held)
        if content != self._state.content:
            self._state.content = content
        assign(self._progress, round(100 * self._done(task, motion), 1))
        if motion is not None and (percent := round(100 * motion.speed_scaling)) != self._speed_heard:
            self._speed_heard = self._speed_told = percent  # what a person is just setting is heard of when it is set
            assign(self._speed, max(SLOWEST, percent))

    def show_contours(self, contours: Contours) -> None:
        """Offer the objects of the picture, the chosen one marked."""
        if self._choices is None:
            return
        self._contours = [contour.label for contour in contours.contours]
        marked = (f"{'● ' if contour.index == contours.selected else ''}{contour.label}"
                  for contour in contours.contours)
        options = (*marked, LARGEST)
        if options != self._choices.options:
            self._choices.options = options

    @staticmethod
    def _done(task: TaskStatus | None, motion: MotionStatus | None) -> float:
        if task is not None and task.state == "DONE":
            return 1.0
        if task is None or isinstance(task, OutlineStatus):
            return motion.progress if motion and motion.state == "active" else 0.0
        return min(1.0, task.done / task.total) if task.total else 0.0

    async def _stop(self) -> None:
        await self._requests.stop()
        self.tell("Stopped", "busy")

    async def _command(self, chosen: str) -> None:
        if chosen in COMMANDS:
            self.tell("")
            await self._requests.command(chosen.lower())

    async def _set_speed(self, percent: float) -> None:
        self._speed_told = round(percent)
        await asyncio.sleep(SLIDING)
        if self._speed_told == round(percent):  # the slider came to rest there
            try:
                await self._requests.set_speed(percent / 100)
            except ZencellError:
                assign(self._speed, max(SLOWEST, self._speed_heard))
                raise

    async def _choose(self, chosen: str) -> None:
        self.tell("")
        label = chosen.removeprefix("● ")
        await self.choose(OutlineSelect(rule="index", index=self._contours.index(label))
                          if label in self._contours else OutlineSelect(rule="auto"))

    async def choose(self, choice: OutlineSelect) -> None:
        """Have an object outlined and say which it is."""
        chosen = await self._requests.choose(choice)
        self.tell(f"{chosen.label} is chosen", "good")
