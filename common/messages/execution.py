"""Moving the arm and the fingers, and how far they are."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from common.messages.basics import Finite, Fraction, Header, Message, Name
from common.messages.robot import JointTrajectory

GoalState = Literal["none", "rejected", "active", "succeeded", "aborted", "cancelled"]
Holder = Literal["person", "watchdog", "controller"]


class ExecuteRequest(Message):
    """Follow a trajectory. The requester mints `id`; the same id never moves the robot twice.

    The header says when that was decided: a request that comes too late is refused.
    """

    header: Header = Header()
    id: Name
    trajectory: JointTrajectory


class StopRequest(Message):
    """Bring the robot to rest. An empty id stops whatever runs."""

    id: str = ""
    reason: str = "asked to"


class HoldRequest(Message):
    """Bring the robot to rest on its path and keep it there, or let it go on. The goal stays active meanwhile."""

    hold: bool
    reason: str = ""
    by: Literal["person", "watchdog"] = Field(
        "person", description="each lets go only of its own hold; the robot moves when nobody holds it"
    )


class MotionStatus(Message):
    """State of the newest goal, and the answer to execute, stop and hold."""

    header: Header = Header()
    id: str = ""
    state: GoalState = "none"
    progress: Fraction = 0.0
    error: str = Field("", description="code, such as start_mismatch, limit, path_tolerance, cancelled")
    message: str = ""
    source: str = Field("", description="who said so: the controller by its name, or hardware")
    held: bool = Field(False, description="kept at rest on its path until let go; no new goal begins to move")
    held_by: list[Holder] = []
    speed_scaling: Fraction = Field(1.0, description="trajectories are followed at this share of their speed")

    @property
    def paused(self) -> bool:
        """Whether somebody has to let go of the robot: watchdog and controller do so by themselves."""
        return self.held and (not self.held_by or "person" in self.held_by)


class GripperCommand(Message):
    """Move the fingers to a width [m]. The requester mints `id`; the same id never moves them twice."""

    id: Name
    width: Annotated[float, Field(ge=0, le=0.2, allow_inf_nan=False)]
    effort: Annotated[float, Field(ge=0, le=1e4, description="grip force [N]; 0: as much as the gripper has")] = 0.0


class GripperState(Message):
    """Width between the fingers [m], whether something is between them, and the newest command."""

    header: Header = Header()
    width: Finite = 0.0
    position: Finite = Field(0.0, description="driven joint [rad or m]")
    effort: Finite = Field(0.0, description="what the fingers press with [N]")
    holding: bool = False
    moving: bool = False
    id: str = ""
    state: GoalState = "none"
    message: str = ""
    source: str = Field("", description="name of the gripper's controller")
