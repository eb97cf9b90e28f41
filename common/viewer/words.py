"""What states and codes are called on the page."""

from __future__ import annotations

from common.applications.outlining.messages import OutlineStatus
from common.applications.pick_place.messages import PickPlaceStatus
from common.errors import NoResponder, RemoteError, ZencellError
from common.messages import GripperState, MotionStatus, PlanResponse, TaskStatus
from common.viewer.markup import BAD, BUSY, GOOD, OFF

TASK_STATES = {
    "IDLE": "Waiting",
    "GRASPING": "Taking",
    "PLACING": "Placing",
    "HOMING": "Going home",
    "SELECTING": "Waiting for a choice",
    "PLANNING": "Planning",
    "APPROACHING": "Approaching",
    "TRACING": "Tracing",
    "RETREATING": "Retreating",
    "DONE": "Done",
    "ERROR": "Failed",
}
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
CLOSED = 0.001  # [m]
GOAL_STATES = {
    "none": "at rest",
    "rejected": "motion was refused",
    "active": "moving",
    "succeeded": "at rest",
    "aborted": "motion was given up",
    "cancelled": "motion was stopped",
}


def task_state(status: TaskStatus | None) -> tuple[str, str]:
    """What the task does, in words, and how that is."""
    if status is None:
        return "Not known yet", OFF
    word = TASK_STATES.get(status.state, status.state.capitalize())
    if status.state == "ERROR":
        return word, BAD
    if status.paused:
        return "Paused", BUSY
    if status.state == "DONE":
        return word, GOOD
    if not status.started:
        return "Stopped" if status.state != "IDLE" else "Waiting for start", OFF
    thing = status.object if isinstance(status, OutlineStatus) else status.subject
    return f"{word} {thing}".rstrip(), GOOD


def service_state(state: str, restarts: int) -> tuple[str, str]:
    """How a process is, in words: one that died is not well before it is ready again."""
    if state == "starting" and restarts:
        return "starts again", BAD
    return SERVICE_STATES[state]


def counters(status: TaskStatus | None, rejected: int) -> dict[str, object]:
    """The figures of the task by their names."""
    if isinstance(status, OutlineStatus):
        return {
            "points": status.points, "outline [mm]": f"{1e3 * status.length_m:.0f}",
            "planned": f"{100 * status.fraction:.0f} %", "failures": status.failures,
        }
    if isinstance(status, PickPlaceStatus):
        return {"placed": status.done, "targets": status.total, "rejected": rejected, "retries": status.retries,
                "failures": status.failures}
    return {}


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
        return "fingers hold something"
    return f"fingers {1e3 * state.width:.0f} mm apart" if state.width >= CLOSED else "fingers closed"


def problem(error: ZencellError) -> str:
    """An error as a person is told it: without what only programs need."""
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
