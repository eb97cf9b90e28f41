"""Texts of the page for states, errors and rejected targets. A state's kind is its color: good, busy, bad, off."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from common.application import Application
from common.client.operator_motion import AT_REST
from common.errors import NoResponder, RemoteError, ZencellError
from common.messages import (
    GripperState,
    MarkerArray,
    MotionStatus,
    PlanResponse,
    PoseArray,
    Rejections,
    RobotStatus,
    TaskStatus,
    Wrench,
)
from page.application import ApplicationPage, page_of
from page.markup import BAD, BUSY, GOOD, OFF
from page.nodes import Position, position_of

STATES = {"IDLE": "Waiting", "HOMING": "Moving to home", "DONE": "Done", "ERROR": "Failed"}
SERVICE_STATES = {
    "waiting": ("waiting", OFF),
    "starting": ("starting", BUSY),
    "ready": ("ready", GOOD),
    "restarting": ("crashed", BAD),
    "stopping": ("stopping", OFF),
    "stopped": ("stopped", OFF),
    "failed": ("failed", BAD),
    "gone": ("not running", BAD),
}
CONTROLLER_MODES = {
    "disconnected": ("Disconnected", BAD),
    "off": ("Power off", OFF),
    "idle": ("Not enabled", BUSY),
    "running": ("Ready", GOOD),
    "freedrive": ("Freedrive", BUSY),
    "protective_stop": ("Protective stop", BAD),
    "emergency_stop": ("Emergency stop", BAD),
    "fault": ("Fault", BAD),
}
GOAL_STATES = {
    "none": "idle",
    "rejected": "motion rejected",
    "active": "moving",
    "succeeded": "idle",
    "aborted": "motion aborted",
    "cancelled": "motion stopped",
}
# What operators call the keys of the cell.
KEY_NAMES = {
    "motion/status": "the arm", "joint_states": "the joint positions", "gripper/state": "the gripper",
    "gripper/command": "the gripper", "motion/plan": "the motion planner", "motion/execute": "the arm's controller",
    "motion/stop": "the arm's controller", "motion/hold": "the arm's controller", "motion/own": "the arm's controller",
    "planning_scene": "the planning scene", "task/command": "the task", "robot/command": "the robot controller",
    "io/set": "the I/O service", "conveyor/set": "the drive of the belts",
    "world/edit": "the simulated world", "camera/image_raw": "the camera", "camera/camera_info": "the camera",
    "depth_camera/image_raw": "the depth camera", "depth_camera/camera_info": "the depth camera",
}
_KEYS = re.compile(rf"(?<![\w/])({'|'.join(KEY_NAMES)})(?![\w/])")
HINTS = {  # what the figures mean
    "done": "parts that the task has finished, of all that it knows of",
    "cycle time": "average time for one part since the start of the task",
    "per hour": "parts in one hour at this cycle time",
    "rejected": "seen, but not usable: the scene shows where and why",
    "retries": "motions that were planned again",
    "failures": "attempts that failed: the task decided again",
}
CLOSED_WIDTH = 0.001  # [m] below which the gripper counts as closed

USER_ERRORS = (ZencellError, ValidationError)  # caused by what an operator requested, such as a value out of bounds


# --- task ---


def state_name(status: TaskStatus, states: Mapping[str, str]) -> str:
    """Return the name of a task's state for the operator."""
    return states.get(status.state, status.state.replace("_", " ").capitalize())


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """Return the figures of any task by name."""
    figures = {name.replace("_", " "): value for name, value in status.figures.items() if value is not None}
    seen = {"rejected": rejected} if rejected else {}
    return {"done": of_total(status), **throughput(status), **figures, **seen, "retries": status.retries,
            "failures": status.failures}


def of_total(status: TaskStatus) -> str:
    """Return how much is done: 2 of 8."""
    return f"{status.done} of {status.total}" if status.total else str(status.done)


def throughput(status: TaskStatus) -> dict[str, str]:
    """Return cycle time and rate of a task that has done something, by name, in cell time."""
    if not status.done or status.task_seconds <= 0:
        return {"cycle time": "–", "per hour": "–"}
    cycle = status.task_seconds / status.done
    return {"cycle time": f"{cycle:.1f} s", "per hour": f"{3600 / cycle:.0f}"}


def progress(status: TaskStatus, motion: MotionStatus | None) -> float:
    """Return the progress of any task, 0 to 1; without a total, the progress of the current motion."""
    return min(1.0, status.done / status.total) if status.total else motion_progress(motion)


def motion_progress(motion: MotionStatus | None) -> float:
    """Return the progress of the current motion, 0 to 1."""
    return motion.progress if motion is not None and motion.state == "active" else 0.0


@dataclass(frozen=True)
class TaskText:
    """Texts for a task: those of its application, or texts that fit any task."""

    states: Mapping[str, str] = field(default_factory=lambda: STATES)
    counters: Callable[[TaskStatus, int], Mapping[str, object]] = counters
    progress: Callable[[TaskStatus, MotionStatus | None], float] = progress
    latency: str = ApplicationPage.latency
    unknown: str = "Task state unknown"

    @classmethod
    def of(cls, application: Application | None) -> TaskText:
        """Return the texts of an application."""
        page = page_of(application)
        return cls({**STATES, **page.states}, page.counters or counters, page.progress or progress, page.latency,
                   cls.unknown if application is not None else "No task")

    def state(self, status: TaskStatus | None) -> tuple[str, str]:
        """Return the state of the task and its kind."""
        if status is None:
            return self.unknown, OFF
        name = state_name(status, self.states)
        if status.state == "ERROR":
            return name, BAD
        if status.paused:
            return "Paused", BUSY
        if status.state == "DONE":
            return name, GOOD
        if not status.started:
            return "Stopped" if status.state != "IDLE" else "Ready", OFF
        return f"{name} {status.subject.replace('_', ' ')}".rstrip(), GOOD

    def progress_of(self, status: TaskStatus | None, motion: MotionStatus | None) -> float:
        """Return the progress of the task, 0 to 1."""
        if status is None:
            return motion_progress(motion)
        return 1.0 if status.state == "DONE" else self.progress(status, motion)


# --- why a button is disabled; empty texts mean that it is enabled ---


def arm_blocked(task: TaskStatus | None, motion: MotionStatus | None) -> str:
    """Return why no operator can move the arm now."""
    if motion is None:
        return "the arm's state is unknown: its controller does not respond"
    if motion.fault:
        return f"robot fault: {motion.fault}"
    if task is not None and task.paused:
        return "the paused task controls the arm: press STOP to end it"
    if task is not None and task.started and task.state not in AT_REST:
        return "the task controls the arm: press STOP to end it"
    return ""


def jog_blocked(motion: MotionStatus | None) -> str:
    """Return why the arm cannot be jogged now, apart from `arm_blocked`."""
    if motion is None:
        return ""
    if motion.held:
        return "the arm is held: press Resume to release it"
    return "the arm is executing a motion" if motion.state == "active" else ""


def command_blocked(
    task: TaskStatus | None, motion: MotionStatus | None, *, has_task: bool = True
) -> dict[str, str]:
    """Return why each command to the task would have no effect now; `has_task` is False for a cell without one."""
    if not has_task:
        return dict.fromkeys(("Start", "Pause", "Resume"), "this cell has no task")
    if task is None:
        return dict.fromkeys(("Start", "Pause", "Resume"), "the task's state is unknown: it does not respond")
    if motion is None:
        return dict.fromkeys(("Start", "Pause", "Resume"), "the arm's controller does not respond")
    stopped = bool(motion.stopped)
    running = task.started and task.state not in ("DONE", "ERROR")
    paused = task.paused or motion.paused
    moving = motion.state == "active"
    fault = f"robot fault: {motion.fault}" if motion.fault else ""
    start = fault or ("" if stopped else "paused: press Resume" if paused else "already running" if running else "")
    pause = "already paused" if paused else "" if running or moving else "nothing is running"
    resume = "nothing is paused" if not paused else "the arm was stopped: press Start" if stopped else fault
    return {"Start": start, "Pause": pause, "Resume": resume}


# --- services, arm, gripper ---


def service_state(state: str, restarts: int) -> tuple[str, str]:
    """Return the state of a process and its kind; a crashed one is bad until it is ready again."""
    if state == "starting" and restarts:
        return "restarting", BAD
    return SERVICE_STATES[state]


def controller_mode(robot: RobotStatus) -> tuple[str, str]:
    """Return the mode of the robot controller and its kind."""
    return CONTROLLER_MODES[robot.mode]


def motion_text(status: MotionStatus | None) -> str:
    """Return the state of the arm's motion."""
    if status is None:
        return "state unknown"
    state = "held" if status.held else GOAL_STATES[status.state]
    if status.state == "active" and not status.held:
        state += f", {100 * status.progress:.0f} % of this motion"
    return state


def gripper_text(state: GripperState | None) -> str:
    """Return the state of the gripper."""
    if state is None:
        return "gripper state unknown"
    if state.holding:
        return "gripper holds an object" + (", which is slipping" if state.outcome == "slipping" else "")
    return f"gripper open {1e3 * state.width:.0f} mm" if state.width >= CLOSED_WIDTH else "gripper closed"


# --- errors and plans ---


def wrench_text(wrench: Wrench | None, limit: float) -> str:
    """Return the force at the tool in its axes and the hard limit [N] of force motions; empty without a sensor."""
    if wrench is None or wrench.force is None:
        return ""
    x, y, z = wrench.force.x, wrench.force.y, wrench.force.z
    return f"{math.hypot(x, y, z):.1f} N (x {x:.1f}, y {y:.1f}, z {z:.1f}), limit {limit:g} N" + (
        "" if wrench.zeroed else ", not zeroed")


def error_text(error: ZencellError | ValidationError) -> str:
    """Return an error for the operator, without details for programs."""
    if isinstance(error, ValidationError):
        first, *more = error.errors()
        where = ".".join(map(str, first["loc"])) or error.title
        return f"{where}: {first['msg']}" + (f" (and {len(more)} more)" if more else "")
    if isinstance(error, RemoteError):
        return error.message
    if isinstance(error, NoResponder):
        return f"{KEY_NAMES.get(error.key, error.key)} does not respond"
    return str(error)


def plain(message: str) -> str:
    """Return a message with the operators' names of keys."""
    return _KEYS.sub(lambda found: KEY_NAMES[found[0]], message)


def plan_text(response: PlanResponse) -> str:
    """Return the result of planning in one line; after a failure with the objects that would collide."""
    if response.ok:
        points = response.trajectory.points if response.trajectory else []
        motion = f"motion of {points[-1].time_from_start:.1f} s" if points else "no motion needed"
        return f"Planned by {response.planner} in {1e3 * response.seconds:.0f} ms: {motion}"
    line = response.message or response.error
    if response.colliding and not all(name in line for name in response.colliding):
        line += f"; {response.colliding[0]} would collide with {response.colliding[1]}"
    return line


SAME_DISTANCE = 0.03  # [m] within which rejections and detections belong to the same object
TIMEOUT = 3_000_000_000  # [ns, cell time] without a detection; a validator may take 2 s to reject
MAX_POSITIONS = 60


@dataclass(eq=False)
class RejectedPosition:
    """A position with the reason of its newest rejection."""

    at: Position
    reason: str
    since: int  # stamp of the rejection [ns]
    last_seen: int  # stamp of the newest detection there [ns]


class RejectedPositions:
    """The rejected positions, oldest rejection first."""

    def __init__(self) -> None:
        """Start empty."""
        self.positions: list[RejectedPosition] = []

    def update(self, message: Any) -> None:
        """Process rejections, targets, or detections, all in world.

        A position is forgotten when a target is there, or when nothing has been detected there for a while.
        """
        if isinstance(message, Rejections | PoseArray | MarkerArray):
            self._handle_clock_reset(message.header.stamp)
        if isinstance(message, Rejections):
            self._add(message)
        elif isinstance(message, PoseArray):
            targets = [position_of(pose) for pose in message.poses]
            self.positions = [
                p for p in self.positions if message.header.stamp < p.since or not _near(p.at, targets)]
        elif isinstance(message, MarkerArray):
            found = [position_of(marker.pose) for marker in message.markers]
            for position in self.positions:
                if _near(position.at, found):
                    position.last_seen = max(position.last_seen, message.header.stamp)
            self.positions = [p for p in self.positions if message.header.stamp - p.last_seen <= TIMEOUT]

    def _handle_clock_reset(self, stamp: int) -> None:
        """Restart the timeout of positions if a stamp [ns] shows that the clock was set back."""
        for position in self.positions:
            if position.last_seen - stamp > TIMEOUT:
                position.since = position.last_seen = stamp

    def _add(self, message: Rejections) -> None:
        """Add rejections; each replaces an earlier one at the same position."""
        stamp = message.header.stamp
        for each in message.rejected:
            at = (each.position.x, each.position.y, each.position.z)
            others = [position for position in self.positions if not _near(position.at, [at])]
            self.positions = [*others, RejectedPosition(at, each.reason, stamp, stamp)][-MAX_POSITIONS:]


def _near(at: Position, others: list[Position]) -> bool:
    return any(math.dist(at, other) < SAME_DISTANCE for other in others)
