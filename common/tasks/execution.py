"""One stage of a task in the hands of the controllers, from asking for it to its end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from common import messages as m

S = TypeVar("S")

Report = m.MotionStatus | m.GripperState
MOST_FIGURES = 200  # plans that a status tells of: a cell may run for days


@dataclass(eq=False)
class Execution(Generic[S]):
    """A stage that was begun: `command` was sent at `since` [s, cell time] and may have been accepted."""

    stage: S
    command: m.ExecuteRequest | m.GripperCommand
    since: float
    accepted: int | None = None  # stamp of the answer that accepted it

    @property
    def moves_arm(self) -> bool:
        """Whether the arm moves, and not the fingers."""
        return isinstance(self.command, m.ExecuteRequest)

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


def note_plan(status: m.TaskReport, response: m.PlanResponse) -> None:
    """Count a plan response in the figures of a task: its time always, its planner when it brought a trajectory."""
    status.planning_seconds += response.seconds
    if not response.ok or response.trajectory is None:
        return
    status.plans.append(m.PlanFigure(
        planner=response.planner, seconds=response.seconds, fraction=response.fraction,
        attempts=max(1, len(response.attempts)),
    ))
    del status.plans[:-MOST_FIGURES]
