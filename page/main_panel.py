"""The panel that is always visible: commands and figures of the task, control of the arm, and the robot controller."""

from __future__ import annotations

import asyncio
import contextlib
from functools import partial
from typing import Literal

import viser

from common import topics
from common.errors import RemoteError, ZencellError
from common.messages import MotionOwner, MotionStatus, RobotCommand, RobotStatus, TaskStatus
from common.time_source import monotonic
from page.access import CURRENT_SESSION
from page.console import SLIDER_DEBOUNCE, Console, assign, stopped_by
from page.markup import STYLE, Html, block, buttons, fields, line, live, press, span, text
from page.status_text import HINTS, TaskText, command_blocked, controller_mode, error_text, plain
from page.viser_inside import element_id

COMMANDS = ("Start", "Pause", "Resume")
MIN_SPEED = 5  # [%]
CONTROLLER_COMMANDS = {"Enable": "enable", "Recover": "recover"}
CONTROLLER_TIMEOUT = 35.0  # [s] wall: powering the joints and releasing the brakes takes long


class TaskPanel:
    """Shows the state of the task and sends it commands.

    Attributes:
        note: number, text and kind of the newest message for operators.
        note_time: when it was shown [s, monotonic].
    """

    def __init__(self, gui: viser.GuiApi, console: Console, task_text: TaskText) -> None:
        """Build the panel; `console` sends the commands, `task_text` has the texts for the task."""
        self._console, self._text = console, task_text
        self._rejected: object = None  # the rejected request; requesting it again overrides other operators
        self._entered_speed = self._shown_speed = 100  # [%]
        self.note, self.note_time = (0, "", ""), 0.0
        gui.add_html(STYLE)
        palette = gui.add_command("Stop arm and task", icon=viser.Icon.HAND_STOP)

        async def stop_pressed(_event: object) -> None:
            console.put(self._stop)

        console.permissions.require(element_id(palette), "stop", "STOP")
        palette.on_trigger(stop_pressed)
        for name in COMMANDS:
            console.on_press(name.lower(), partial(self._command, name), name)
        console.on_press("take", partial(self._own, "take"), "Take control of the arm")
        console.on_press("give", partial(self._own, "give"), "Release control of the arm")
        console.on_press("operate", self._operate, "Take control of the page", "take")
        console.on_press("leave", self._leave, "Release control of the page", "look")
        self._buttons = Html(gui)
        self._speed = gui.add_slider("Speed [%]", MIN_SPEED, 100, 5, 100, hint="scales planned speeds; acts at once")
        console.on_change(self._speed, self._set_speed)
        # Below the buttons: the number of lines changes, and buttons must not move under the pointer.
        self._state = Html(gui)
        self._progress = gui.add_progress_bar(0.0)

    def notify(self, message: str, kind: str = "bad") -> None:
        """Show a message for operators in the status bar of every page; an empty one clears it."""
        self.note, self.note_time = (self.note[0] + 1, plain(message), kind), monotonic()

    def show(
        self, task: TaskStatus | None, motion: MotionStatus | None, owner: MotionOwner | None, rejected: int
    ) -> None:
        """Update the panel.

        Args:
            task: its status.
            motion: motion status of the arm.
            owner: motion owner.
            rejected: number of rejected targets.
        """
        self._show_buttons(task, motion, owner)
        # The status bar shows the state: here are the details of a task that runs, and its figures.
        lines = []
        if task is not None and task.started and not task.paused and task.state not in ("DONE", "ERROR"):
            lines.append(_labeled("Step:", task.stage.replace("_", " ").replace("-", " ") or "–"))
        if task is not None:
            lines.append(fields(self._text.counters(task, rejected), HINTS))
        self._state.set(block("".join(lines), "task", state=task.state if task else "",
                              paused=bool(task and task.paused), held=motion.held if motion else False))
        assign(self._progress, round(100 * self._text.progress_of(task, motion), 1))
        if motion is not None and (percent := round(100 * motion.speed_scaling)) != self._shown_speed:
            self._shown_speed = self._entered_speed = percent
            assign(self._speed, max(MIN_SPEED, percent))

    def _show_buttons(self, task: TaskStatus | None, motion: MotionStatus | None, owner: MotionOwner | None) -> None:
        task = task if self._console.is_available(topics.TASK_COMMAND) else None
        motion = motion if self._console.is_available(topics.MOTION_STOP) else None
        blocked = command_blocked(task, motion, has_task=self._console.has_task)
        permissions = self._console.permissions
        taken = owner is not None and owner.kind == "operator"
        ours = taken and owner is not None and owner.asked and owner.owner == permissions.client_name
        rows = [
            buttons(*(press(name, name.lower(), blocked[name], main=name != "Pause") for name in COMMANDS),
                    label="Task"),
            f'<div class="buttons">{span("Control:", "dim")}{live("control")}'
            + press("Take control", "take", "this page controls the arm already" if ours else "")
            + press("Release control", "give", "" if taken else "no operator controls the arm") + "</div>",
        ]
        if permissions.enforced:
            rows.append(buttons(
                press("Take page control", "operate"),
                press("Release page control", "leave", "" if permissions.operating_page else "no page has control"),
                label="Operating page"))
        self._buttons.set(block("".join(rows), "orders"))

    # --- commands ---

    async def stop(self) -> str:
        """Stop arm and task; return a line with what was stopped.

        Raises:
            RequestFailed: the arm was not stopped.
        """
        try:
            result = await self._console.stop()
        except ZencellError as error:
            self.notify(f"NOT stopped: {error_text(error)}")
            raise
        # The status bar shows a stop of all by itself.
        self.notify(*(("",) if result == stopped_by(self._console.permissions.client_name) else (result, "bad")))
        return result

    async def _stop(self) -> None:
        with contextlib.suppress(ZencellError):  # `stop` has shown it
            await self.stop()

    def _operate(self) -> None:
        self.notify(f"{CURRENT_SESSION.get()} has control now", "good")  # with its name: every page shows the line

    def _leave(self) -> None:
        session = CURRENT_SESSION.get()
        if self._console.permissions.release(session):
            self.notify("No page has control now", "good")
        else:
            self.notify(f"{session or 'This page'} has no control to release")

    @property
    def _situation(self) -> object:
        """Newest interlock and motion owner: repeating a rejected request overrides just these."""
        owner = self._console.latest(topics.MOTION_OWNER)
        return self._console.acknowledged, owner.owner if owner is not None else ""

    async def _own(self, act: Literal["take", "give"]) -> None:
        request = act, self._situation
        over, self._rejected = self._rejected == request, None
        try:
            owner = await self._console.own(act, over)
        except RemoteError as error:
            if act == "give" or error.code != "not_owner":
                raise
            self._rejected = request
            self.notify(f"{error_text(error)}: press Take control again to override")
        else:
            failed = act == "give" and owner.owner not in ("", self._console.permissions.client_name)
            if failed:
                self.notify(f"This page has no control to release: {owner.owner} controls the arm")
            else:
                self.notify(f"{owner.owner or 'No operator'} controls the arm now", "good")

    async def _command(self, name: str) -> None:
        self.notify("")
        request = name, self._situation
        override, self._rejected = self._rejected == request, None
        try:
            await self._console.command(name.lower(), override)
        except RemoteError as error:
            if error.code not in ("held", "not_owner"):
                raise
            self._rejected = request
            self.notify(f"{error_text(error)}: press {name} again to override")

    async def _set_speed(self, percent: float) -> None:
        self._entered_speed = round(percent)
        await asyncio.sleep(SLIDER_DEBOUNCE)
        if self._entered_speed == round(percent):  # the slider was not moved meanwhile
            try:
                await self._console.set_speed(percent / 100)
            except ZencellError:
                assign(self._speed, max(MIN_SPEED, self._shown_speed))
                raise


def _labeled(label: str, value: str) -> str:
    return f"<div>{span(label, 'dim')} {text(value)}</div>"


class ControllerPanel:
    """Shows the mode of the robot controller, enables it and recovers it; hidden without such a controller."""

    def __init__(self, gui: viser.GuiApi, console: Console) -> None:
        """Build the panel."""
        self._console = console
        self._folder = gui.add_folder("Robot controller", visible=False)
        with self._folder:
            group = gui.add_button_group("Command", tuple(CONTROLLER_COMMANDS), hint=(
                "Enable: power and brakes, not in a safety stop. Recover: release a protective stop, once its cause is "
                "found; it powers nothing"))
            console.on_choice(group, self._command)
            self._state = Html(gui)

    def show(self, robot: RobotStatus | None) -> None:
        """Update the panel."""
        has_controller = robot is not None and robot.controller
        if has_controller != self._folder.visible:
            self._folder.visible = has_controller
        if robot is None or not has_controller:
            return
        mode, kind = controller_mode(robot)
        lines = [line(f"● {mode}", kind), fields(
            {"speed slider": f"{robot.speed:.0%}", "max cycle delay": f"{robot.late * 1e3:.0f} ms"},
            {"speed slider": "share of the speed that the robot's own pendant allows"})]
        self._state.set(block("".join(lines), "robot", mode=robot.mode))

    async def _command(self, name: str) -> None:
        command = RobotCommand.model_validate({
            "header": self._console.header(), "act": CONTROLLER_COMMANDS[name],
            "owner": self._console.permissions.client_name})
        self._console.notify(f"{name}: requested", "busy")
        answer = await self._console.call(topics.ROBOT_COMMAND, command, CONTROLLER_TIMEOUT)
        self._console.notify(f"{name}: {controller_mode(answer)[0].lower()}", "good")
