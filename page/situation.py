"""The situation of a cell in one line for the status bar: what is the case, since when, and what to do next."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from common.messages import Interlock, MotionOwner, MotionStatus, RobotStatus, TaskStatus
from page.markup import BAD, BUSY, GOOD, OFF
from page.status_text import TaskText, controller_mode, motion_text, of_total, plain

START, RESUME = "Check the cell, then press Start.", "Press Resume to continue."
ROUTINE = ("stopped on the page", "the operator sent", "the task is paused")  # reasons that only repeat the fact
CONTROLLER_HINTS = {
    "disconnected": "Check the power and the network cable of the robot.",
    "off": "Press Enable.",
    "idle": "Press Enable.",
    "freedrive": "The arm is moved by hand.",
    "protective_stop": "Remove the cause, then press Recover.",
    "emergency_stop": "Release the emergency stop button, then press Recover and Enable.",
    "fault": "Remove the cause, then press Recover.",
}


@dataclass(frozen=True)
class Situation:
    """What the status bar shows first.

    Attributes:
        text: what is the case.
        kind: its color: bad and busy color the whole bar.
        hint: what the operator can do.
        since: start [ns since the Unix epoch]; 0: not shown.
    """

    text: str = ""
    kind: str = OFF
    hint: str = ""
    since: int = 0


def situation(
    text: TaskText, task: TaskStatus | None, motion: MotionStatus | None, owner: MotionOwner | None,
    robot: RobotStatus | None,
) -> Situation:
    """Return the most important of all that is the case.

    Args:
        text: texts for the task.
        task: its status.
        motion: motion status of the arm; None: the arm does not respond.
        owner: motion owner.
        robot: status of the robot controller.
    """
    if motion is None:
        return Situation("Arm state unknown", OFF, "The arm's controller does not respond.")
    if robot is not None and robot.controller and robot.mode in CONTROLLER_HINTS:
        mode, kind = controller_mode(robot)
        message = f": {robot.message}" if robot.message else ""
        return Situation(f"{mode}{message}", kind if kind != OFF else BUSY, CONTROLLER_HINTS[robot.mode])
    if motion.fault:
        return Situation(f"Robot fault: {motion.fault}", BAD, "Remove the cause.")
    return (_interlocked(task, motion) or _task_ended(text, task)
            or _moving(text, task, motion, jogging=owner is not None and owner.jogging))


def _interlocked(task: TaskStatus | None, motion: MotionStatus) -> Situation | None:
    stops = [each for each in motion.interlocks if each.kind == "stopped"]
    if stops:
        return Situation(f"Stopped by {_names(stops)}", BUSY, START if task is not None else "Check the cell.",
                         max(each.since for each in stops))
    holds = [each for each in motion.interlocks if each.kind == "held"]
    since = max((each.since for each in holds), default=0)
    if motion.paused or (task is not None and task.paused):
        return Situation("Paused" + (f" by {_names(holds)}" if holds else ""), BUSY, RESUME, since)
    if motion.held:
        return Situation(f"Arm waits: {plain('; '.join(each.reason or each.by for each in holds)) or 'held'}", BUSY,
                         "It continues by itself.", since)
    return None


def _names(interlocks: Iterable[Interlock]) -> str:
    """Return who requested interlocks, with their reasons unless these only repeat the fact."""
    return ", ".join(
        f"{each.by}: {each.reason}" if each.reason and not each.reason.startswith(ROUTINE) else each.by
        for each in interlocks)


def _task_ended(text: TaskText, task: TaskStatus | None) -> Situation | None:
    if task is None or task.state not in ("DONE", "ERROR"):
        return None
    state, kind = text.state(task)
    if task.state == "ERROR":
        return Situation(f"{state}: {plain(task.message)}" if task.message else state, kind, START)
    return Situation(state, kind, "Press Start to run the task again.")


def _moving(text: TaskText, task: TaskStatus | None, motion: MotionStatus, *, jogging: bool) -> Situation:
    if jogging:
        return Situation("Jogging", GOOD)
    if task is not None and task.started:
        return Situation(*text.state(task), plain(task.message) or (f"{of_total(task)} done" if task.total else ""))
    if motion.state == "active":
        return Situation("Moving", GOOD)
    if task is not None and task.state == "IDLE":
        return Situation("Ready", GOOD, plain(task.message) or "Press Start to run the task.")
    return Situation("Arm idle", OFF, START if task is not None else "")


def control_text(owner: MotionOwner | None, client: str) -> str:
    """Return who controls the arm, as the client `client` sees it."""
    if owner is None:
        return "unknown"
    if owner.kind in ("none", "task"):
        return {"none": "free", "task": "task"}[owner.kind]
    return "you" if owner.owner == client else owner.owner or owner.kind


def summarize(
    cell: str, motion: MotionStatus | None, gripper: str, operating_page: str | None, alarms: int,
) -> tuple[tuple[str, str], ...]:
    """Return the texts of the second line of the status bar, each with its kind.

    Args:
        cell: its name.
        motion: motion status of the arm.
        gripper: text for the state of the gripper.
        operating_page: the page that operates; None without access tokens.
        alarms: number of alarms that no operator has acknowledged.
    """
    summary = [(cell, "dim"), (f"arm {motion_text(motion)}", ""), (gripper, "")]
    if operating_page is not None:
        summary.append((f"operating page: {operating_page or 'none'}", "dim"))
    if alarms:
        summary.append((f"{alarms} alarm{'s' if alarms > 1 else ''}: see Log", BAD))
    return tuple(summary)
