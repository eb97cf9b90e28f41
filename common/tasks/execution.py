"""One stage of a task in the hands of the controllers, from asking for it to its end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from common import messages as m

S = TypeVar("S")

Report = m.MotionStatus | m.GripperState
ANEW = ("busy", "stale_request", "clock_ahead")  # refusals of a motion that have nothing to do with the motion
FOUND_HELD = "the robot was found held; resume or start to go on"
MOST_FIGURES = 200  # plans that a status tells of: a cell may run for days


@dataclass(eq=False)
class Execution(Generic[S]):
    """A stage that was begun: `command` was sent and may have been accepted. Times are cell time [s].

    While the arm is held no time counts, and at a share of its speed only that share of it.
    """

    stage: S
    command: m.ExecuteRequest | m.GripperCommand
    counted: float  # up to when; from the begin on
    moving: float = 0.0  # in motion so far
    spent: float = 0.0  # as if the motion were at full speed: what time-outs go by
    accepted: int | None = None  # stamp of the answer that accepted it

    @property
    def moves_arm(self) -> bool:
        """Whether the arm moves, and not the fingers."""
        return isinstance(self.command, m.ExecuteRequest)

    def count(self, now: float, motion: m.MotionStatus) -> None:
        """Count the time up to now."""
        passed, self.counted = max(0.0, now - self.counted), max(now, self.counted)
        if self.moves_arm and motion.held:
            return
        self.moving += passed
        self.spent += passed * (motion.speed_scaling if self.moves_arm else 1.0)

    def accept(self, answer: Report) -> bool:
        """Take in the answer to the command: whether it was accepted."""
        if answer.state != "rejected":
            self.accepted = answer.header.stamp
        return answer.state != "rejected"

    def outcome(self, motion: m.MotionStatus, gripper: m.GripperState) -> Literal["running", "ended", "forgotten"]:
        """What the controllers say of it; forgotten once they accepted it and tell of another goal."""
        reported = self.report(motion, gripper)
        if reported.id == self.command.id:
            return "ended" if reported.state in ("succeeded", "aborted", "cancelled") else "running"
        later = self.accepted is not None and reported.header.stamp > self.accepted
        return "forgotten" if later else "running"

    def report(self, motion: m.MotionStatus, gripper: m.GripperState) -> Report:
        """The report of the controller that the command went to."""
        return motion if self.moves_arm else gripper


def note_plan(status: m.TaskStatus, response: m.PlanResponse) -> None:
    """Count a plan response in the figures of a task: its time always, its planner when it brought a trajectory."""
    status.planning_seconds += response.seconds
    if not response.ok or response.trajectory is None:
        return
    status.plans.append(m.PlanFigure(
        planner=response.planner, seconds=response.seconds, fraction=response.fraction,
        attempts=max(1, len(response.attempts)),
    ))
    del status.plans[:-MOST_FIGURES]
