"""The panel that is always there: what the task does, what a person tells it, and whose the arm is."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, Literal

import viser

from common import topics
from common.errors import RemoteError, ZencellError
from common.messages import MotionOwner, MotionStatus, TaskStatus
from page import words
from page.console import SLIDING, Console, assign
from page.doors import VISITOR
from page.markup import STYLE, block, buttons, fields, press, span, text
from page.words import problem

COMMANDS = ("Start", "Pause", "Resume")
SLOWEST = 5  # [%]


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
        self._refused: object = None  # command that was, because of others, with what they had said by then
        self._speed_told = self._speed_heard = 100  # [%]
        self.note = (0, "", "")  # the newest line for persons, and how good it is
        gui.add_html(STYLE)
        palette = gui.add_command("Stop the arm and the task", icon=viser.Icon.HAND_STOP)

        async def pressed(_event: object) -> None:
            console.put(self._stop)

        console.doors.need(palette._impl.uuid, "stop", "STOP")
        palette.on_trigger(pressed)
        for name in COMMANDS:
            console.on_press(name.lower(), partial(self._command, name), name)
        console.on_press("home", home, "Go home")
        console.on_press("take", partial(self._own, "take"), "Take the arm")
        console.on_press("give", partial(self._own, "give"), "Give the arm back")
        console.on_press("operate", self._operate, "Take over", "take")
        console.on_press("leave", self._leave, "Let others operate", "look")
        self._buttons = gui.add_html("")
        self._speed = gui.add_slider("Speed [%]", SLOWEST, 100, 5, 100, hint="share of the planned speed, at once")
        console.on_change(self._speed, self._set_speed)
        # Below all that is pressed: lines come and go here, and a button that moves away under the pointer is missed.
        self._state = gui.add_html("")
        self._progress = gui.add_progress_bar(0.0)
        self._notice = gui.add_html("")

    def tell(self, line: str, kind: str = "bad") -> None:
        """Show a line about what a person asked for; an empty one takes it away."""
        self.note = (self.note[0] + 1, line, kind)
        self._notice.content = block(span(line, kind), "notice", kind=kind) if line else ""

    def show(
        self, task: TaskStatus | None, motion: MotionStatus | None, owner: MotionOwner | None, gripper: str,
        rejected: int,
    ) -> None:
        """Show how the task is doing.

        Args:
            task: what it says of itself.
            motion: what the arm does.
            owner: whose the motion is.
            gripper: what the fingers do, in words.
            rejected: places that cannot be taken.
        """
        self._show_buttons(task, motion, owner)
        word, kind = self._words.state(task)
        lines = [f'<div>{span("●", kind + " dot")} {span(word, "big")}</div>']
        if task is not None and task.stage and task.state not in ("DONE", "ERROR"):
            lines.append(f"<div>{span('Step:', 'dim')} {text(task.stage.replace('_', ' '))}</div>")
        if task is not None and task.message:
            lines.append(f"<div>{span(task.message, 'bad' if task.state == 'ERROR' else 'dim')}</div>")
        lines.append(f"<div>{span('Arm:', 'dim')} {text(words.motion(motion))} · {text(gripper)}</div>")
        if owner is not None:
            lines.append(f"<div>{span('The motion is', 'dim')} {text(owner.description)}</div>")
        if self._console.doors.guarded:
            lines.append(f"<div>{span('Operates:', 'dim')} {text(self._console.doors.operator or 'nobody')}</div>")
        for one in motion.interlocks if motion is not None else ():
            if task is None or one.description not in task.message:
                lines.append(f"<div>{span(one.description, 'dim')}</div>")
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

    def _show_buttons(self, task: TaskStatus | None, motion: MotionStatus | None, owner: MotionOwner | None) -> None:
        task = task if self._console.answers(topics.TASK_COMMAND) else None
        motion = motion if self._console.answers(topics.MOTION_STOP) else None
        why_not = words.why_not(task, motion)
        doors = self._console.doors
        rows = [
            buttons(*(press(name, name.lower(), why_not[name]) for name in COMMANDS), label="Task"),
            buttons(
                press("Go home", "home", words.kept(task, motion), arm=True),
                press("Take", "take", "it is taken already" if owner is not None and owner.asked and owner.kind ==
                      "operator" and owner.owner == doors.person else ""),
                press("Give back", "give", "" if owner is not None and owner.kind == "operator" else
                      "no person has it"), label="Arm"),
        ]
        if doors.guarded:
            rows.append(buttons(
                press("Take over", "operate"),
                press("Let others", "leave", "" if doors.operator else "nobody operates"), label="Page"))
        content = block("".join(rows), "orders")
        if content != self._buttons.content:
            self._buttons.content = content

    async def stop(self) -> str:
        """Stop arm and task; returns what was done, in a line.

        Raises:
            RequestFailed: the arm was not stopped.
        """
        try:
            line = await self._console.stop()
        except ZencellError as error:
            self.tell(f"NOT stopped: {problem(error)}")
            raise
        self.tell(line, "busy")
        return line

    async def _stop(self) -> None:
        with contextlib.suppress(ZencellError):  # it is told
            await self.stop()

    def _operate(self) -> None:
        self.tell(f"{VISITOR.get()} operates now", "good")  # by its name: every page shows the line

    def _leave(self) -> None:
        visitor = VISITOR.get()
        if self._console.doors.give_back(visitor):
            self.tell("Nobody operates now", "good")
        else:
            self.tell(f"{visitor or 'This page'} does not operate")

    @property
    def _others(self) -> object:
        """The newest that others said of the arm, and whose it is: who presses twice overrides what they were told."""
        owner = self._console.latest(topics.MOTION_OWNER)
        return self._console.acknowledged, owner.owner if owner is not None else ""

    async def _own(self, act: Literal["take", "give"]) -> None:
        asked = act, self._others
        over, self._refused = self._refused == asked, None
        try:
            now = await self._console.own(act, over)
        except RemoteError as error:
            if act == "give" or error.code != "not_owner":
                raise
            self._refused = asked
            self.tell(f"{problem(error)}: press Take again for that")
        else:
            kept = act == "give" and now.owner not in ("", self._console.doors.person)
            self.tell(f"{'Nothing to give back: the' if kept else 'The'} motion is {now.description}",
                      "bad" if kept else "good")

    async def _command(self, chosen: str) -> None:
        if chosen in COMMANDS:
            self.tell("")
            asked = chosen, self._others
            override, self._refused = self._refused == asked, None
            try:
                await self._console.command(chosen.lower(), override)
            except RemoteError as error:
                if error.code not in ("held", "not_owner"):
                    raise
                self._refused = asked
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
