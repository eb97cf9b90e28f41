"""Labels of states and codes on the page; an application adds its own in `page.application.ApplicationPage`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pydantic import ValidationError

from common.application import Application
from common.client.operator_motion import AT_REST
from common.errors import NoResponder, RemoteError, ZencellError
from common.messages import GripperState, MotionStatus, PlanResponse, RobotStatus, TaskStatus
from page.application import page_of
from page.markup import BAD, BUSY, GOOD, OFF

STATES = {"IDLE": "Waiting", "HOMING": "Going home", "DONE": "Done", "ERROR": "Failed"}
SERVICE_STATES = {
    "waiting": ("waits for others", OFF),
    "starting": ("starting", BUSY),
    "ready": ("ready", GOOD),
    "restarting": ("died", BAD),
    "stopping": ("stopping", OFF),
    "stopped": ("stopped", OFF),
    "failed": ("failed", BAD),
    "gone": ("not there", BAD),
}
ARM_MODES = {
    "disconnected": ("Not connected", BAD),
    "off": ("Without power", OFF),
    "idle": ("Not ready", BUSY),
    "running": ("Can be moved", GOOD),
    "freedrive": ("Moved by hand", BUSY),
    "protective_stop": ("Stopped for protection", BAD),
    "emergency_stop": ("Emergency stop", BAD),
    "fault": ("Does not work", BAD),
}
CLOSED = 0.001  # [m]
GOAL_STATES = {
    "none": "at rest",
    "rejected": "motion was refused",
    "active": "moving",
    "succeeded": "at rest",
    "aborted": "motion was given up",
    "cancelled": "motion was stopped",
}


def arm_mode(robot: RobotStatus) -> tuple[str, str]:
    """How the arm's own controller says that it is, and how good that is."""
    return ARM_MODES[robot.mode]


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """The figures of any task by their names."""
    figures = {name.replace("_", " "): value for name, value in status.figures.items() if value is not None}
    seen = {"rejected": rejected} if rejected else {}
    return {"done": status.done, "of": status.total, **figures, **seen, "retries": status.retries,
            "failures": status.failures}


def progress(status: TaskStatus, motion: MotionStatus | None) -> float:
    """How far any task is, 0 to 1: what is done of what there is, or without a number the motion under way."""
    if status.total:
        return min(1.0, status.done / status.total)
    return motion.progress if motion is not None and motion.state == "active" else 0.0


@dataclass(frozen=True)
class TaskWords:
    """How the task is told of: in words that fit every task, or in those of its application."""

    states: Mapping[str, str] = field(default_factory=lambda: STATES)
    counters: Callable[[TaskStatus, int], Mapping[str, object]] = counters
    progress: Callable[[TaskStatus, MotionStatus | None], float] = progress
    latency: str = "Picture to decision"

    @classmethod
    def of(cls, application: Application | None) -> TaskWords:
        """The words of an application."""
        page = page_of(application)
        return cls({**STATES, **page.states}, page.counters or counters, page.progress or progress, page.latency)

    def state(self, status: TaskStatus | None) -> tuple[str, str]:
        """What the task does, in words, and how that is."""
        if status is None:
            return "Not known yet", OFF
        word = self.states.get(status.state, status.state.replace("_", " ").capitalize())
        if status.state == "ERROR":
            return word, BAD
        if status.paused:
            return "Paused", BUSY
        if status.state == "DONE":
            return word, GOOD
        if not status.started:
            return "Stopped" if status.state != "IDLE" else "Waiting for start", OFF
        return f"{word} {status.subject}".rstrip(), GOOD

    def done(self, status: TaskStatus | None, motion: MotionStatus | None) -> float:
        """How far the task is, 0 to 1."""
        if status is None:
            return motion.progress if motion is not None and motion.state == "active" else 0.0
        return 1.0 if status.state == "DONE" else self.progress(status, motion)


def kept(task: TaskStatus | None, motion: MotionStatus | None) -> str:
    """Why nobody can move the arm by hand now, whoever asks; empty when one can."""
    if motion is None:
        return "the arm does not say how it is, or does not answer"
    if motion.fault:
        return f"the arm does not work: {motion.fault}"
    if task is not None and task.paused:
        return "the task is paused and has the arm: STOP ends it"
    if task is not None and task.started and task.state not in AT_REST:
        return "the task has the arm: STOP ends it"
    return ""


def not_jogged(motion: MotionStatus | None) -> str:
    """What beside a task keeps the arm from being jogged; empty if nothing does."""
    if motion is None:
        return ""
    if motion.held:
        return "the arm is held: Resume or Start lets it go"
    return "the arm follows a motion" if motion.state == "active" else ""


def why_not(task: TaskStatus | None, motion: MotionStatus | None) -> dict[str, str]:
    """Why each order to the task would do nothing now; empty when it would do something."""
    if task is None:
        return dict.fromkeys(("Start", "Pause", "Resume"), "the task does not say how it is, or does not answer")
    stopped = motion is not None and bool(motion.stopped)
    runs = task.started and task.state not in ("DONE", "ERROR")
    paused = task.paused or (motion is not None and motion.paused)
    moves = motion is not None and motion.state == "active"
    start = "" if not runs or stopped else "it is paused: Resume goes on" if paused else "it runs already"
    pause = "it is paused already" if paused else "" if runs or moves else "nothing runs"
    resume = "nothing is paused" if not paused else "the arm was stopped: Start goes on" if stopped else ""
    return {"Start": start, "Pause": pause, "Resume": resume}


def service_state(state: str, restarts: int) -> tuple[str, str]:
    """How a process is, in words: one that died is not well before it is ready again."""
    if state == "starting" and restarts:
        return "starts again", BAD
    return SERVICE_STATES[state]


def motion(status: MotionStatus | None) -> str:
    """What the arm does."""
    if status is None:
        return "not known yet"
    said = "held on its path" if status.held else GOAL_STATES[status.state]
    if status.state == "active" and not status.held:
        said += f", {100 * status.progress:.0f} % of this motion"
    return said


def gripper(state: GripperState | None) -> str:
    """What the fingers do."""
    if state is None:
        return "fingers not known yet"
    if state.holding:
        return "fingers hold something" + (", which slips" if state.outcome == "slipping" else "")
    return f"fingers {1e3 * state.width:.0f} mm apart" if state.width >= CLOSED else "fingers closed"


UNDERSTOOD = (ZencellError, ValidationError)  # what goes wrong by what a person asked for, such as a number too large


def problem(error: ZencellError | ValidationError) -> str:
    """An error as a person is told it: without what only programs need."""
    if isinstance(error, ValidationError):
        first, *more = error.errors()
        where = ".".join(map(str, first["loc"])) or error.title
        return f"{where}: {first['msg']}" + (f" (and {len(more)} more)" if more else "")
    if isinstance(error, RemoteError):
        return error.message
    if isinstance(error, NoResponder):
        return f"nobody answers {error.key} now"
    return str(error)


def plan(response: PlanResponse) -> str:
    """How planning ended, in a line that names what is in the way."""
    if response.ok:
        points = response.trajectory.points if response.trajectory else []
        length = f"a motion of {points[-1].time_from_start:.1f} s" if points else "no motion"
        return f"Planned by {response.planner} in {1e3 * response.seconds:.0f} ms: {length}"
    line = response.message or response.error
    if response.colliding and not all(name in line for name in response.colliding):
        line += f"; {response.colliding[0]} would touch {response.colliding[1]}"
    return line
