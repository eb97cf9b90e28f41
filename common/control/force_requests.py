"""Which force motions start, within which hard limits, and when their requester counts as gone."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NamedTuple

from common.control.force_follower import ForceFollower
from common.control.force_sensing import ForceSensing
from common.control.jogging import ToolKinematics
from common.control.trajectory import Trajectory
from common.control.trajectory_controller import TrajectoryController
from common.control.wrench import Wrenches
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import ForceMotion
from common.time_source import monotonic

KEEP_ALIVE = 1.0  # [s] wall after the newest request of an operator
FEWEST_JOINTS = 6  # of an arm whose tool keeps its orientation on any line


class ForceLimits(NamedTuple):
    """Hard limits of every force motion, at the TCP [N], [N m]."""

    force: float
    torque: float


FORCE_LIMITS = ForceLimits(60.0, 10.0)  # by default

class ForceRequests:
    """Checks requests, and watches their requester.

    Attributes:
        task_present: whether the cell's task is alive: its motion ends with it.
    """

    def __init__(
        self, limits: Limits, kinematics: ToolKinematics | None, most: ForceLimits, period: float
    ) -> None:
        """Check against the limits of the joints and the hard limits; cycles are `period` [s] of cell time apart."""
        self._limits, self._kinematics, self._most, self._period = limits, kinematics, most, period
        self.task_present = False
        self._by_task, self._seen = True, 0.0  # of the motion in progress; wall time of the newest request [s]

    def check(self, request: ForceMotion, no_wrench: str) -> Refused | None:
        """Return why a request cannot be executed, or None; `no_wrench` is why no wrench is measured, else empty."""
        if no_wrench:
            return Refused("no_wrench", f"a force motion needs the wrench at the tool: {no_wrench}")
        if self._kinematics is None:
            return Refused("no_kinematics", "this arm has no known tool")
        if len(self._limits.names) < FEWEST_JOINTS:
            return Refused("too_few_joints", f"force motions need an arm of {FEWEST_JOINTS} joints; it has "
                                             f"{len(self._limits.names)}")
        if not request.owner and not self.task_present:
            return Refused("no_requester", "a request without an owner belongs to the cell's task, which is not alive")
        return None

    def follower(self, request: ForceMotion) -> Callable[[Trajectory, Vector], ForceFollower]:
        """Return what prepares the motion on a checked trajectory from a start (dof,) [rad]."""
        def prepare(trajectory: Trajectory, start: Vector) -> ForceFollower:
            assert self._kinematics is not None
            return ForceFollower(
                request, trajectory, self._kinematics, self._limits, start, *self._most, self._period)

        return prepare

    def seen(self, request: ForceMotion, goal: str) -> None:
        """Record a request, if it is for the goal in progress; it may be a repeated one."""
        if request.id == goal:
            self._by_task, self._seen = not request.owner, monotonic()

    def sense(self, arm: TrajectoryController, q: Vector, sensing: ForceSensing) -> str:
        """Give the reading of a cycle to a force motion; return why its requester is gone, or ""."""
        if (motion := arm.force) is None:
            return ""
        if motion.zeroing and motion.end is None:
            with contextlib.suppress(Refused):  # not at rest for long enough yet
                sensing.zero()
                motion.zeroing = False
        motion.sense(q, Wrenches.of(sensing.estimator))
        if self._by_task:
            return "" if self.task_present else "the task that requested it is gone"
        late = monotonic() - self._seen > KEEP_ALIVE
        return f"it was not requested again for {KEEP_ALIVE:g} s" if late else ""
