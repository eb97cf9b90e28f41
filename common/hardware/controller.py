"""The trajectory controller: takes goals, gives set-points, judges how well they are followed. No clock of its own.

An action's life: rejected at once, or active and then succeeded, aborted or cancelled. One goal at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.errors import Refused
from common.hardware.checks import Tolerances, checked_trajectory
from common.hardware.goals import GoalMemory
from common.hardware.interface import Limits, Vector
from common.hardware.stopping import Stop, plan_stop
from common.hardware.trajectory import Trajectory
from common.messages import GoalState, JointTrajectory, MotionStatus

LARGEST_STEP = 0.1  # cell time [s]: after a stall of the loop a trajectory goes on where it was, instead of jumping
BLEND_TIME = 0.3  # the difference between the robot's and the trajectory's start fades in this time [s]


@dataclass
class _Goal:
    """The goal that moves the robot. `time` is on the trajectory's own time axis [s]."""

    id: str
    trajectory: Trajectory
    offset: Vector
    last: float  # cell time of the newest set-point
    time: float = 0.0
    stop: Stop | None = None
    reason: str = ""
    ended: float | None = None  # cell time at which the set-points came to rest

    def set_point(self) -> tuple[Vector, Vector]:
        """Positions and velocities (dof,) at the goal's time, with what is left of the start's difference."""
        rate = self.stop.rate if self.stop else 1.0
        q, dq, _ = self.trajectory.at(self.time)
        blend = min(BLEND_TIME, self.trajectory.duration)
        u = min(self.time / blend, 1.0)
        left, slope = 1 - u**3 * (10 - 15 * u + 6 * u**2), -30 * u**2 * (1 - u) ** 2 / blend
        return q + left * self.offset, (dq + slope * self.offset) * rate


class TrajectoryController:
    """Follows one trajectory at a time, and holds still between them."""

    def __init__(
        self, limits: Limits, start: Vector, tolerances: Tolerances | None = None, remember: int = 1000,
        name: str = "controller",
    ) -> None:
        """Hold at `start` (dof,) [rad]; `remember` so many goals by their ids; sign reports with the name."""
        self._name = name
        self._limits = limits
        self._tolerances = tolerances or Tolerances()
        self._hold = start.copy()
        self._goal: _Goal | None = None
        self._memory: GoalMemory[MotionStatus] = GoalMemory(remember)
        self._fault = ""
        self.status = MotionStatus()

    def accept(self, goal: str, trajectory: JointTrajectory, now: float, measured: Vector) -> MotionStatus:
        """The state of the goal: active, or rejected with code and message; for a known id what became of it.

        Args:
            goal: id of the goal, minted by the requester. The same id never moves the robot twice.
            trajectory: what to follow.
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
        """
        known = self._memory.get(goal)
        if known is not None:
            return known
        try:
            if self._fault:
                raise Refused("hardware_fault", self._fault)
            if self._goal is not None:
                raise Refused("busy", f"goal {self._goal.id!r} is still being followed")
            checked = checked_trajectory(trajectory, self._limits, measured, self._tolerances)
        except Refused as refusal:
            rejected = MotionStatus(
                id=goal, state="rejected", error=refusal.code, message=str(refusal), source=self._name
            )
            return self._memory.put(goal, rejected)
        # Go on from the set-point, unless the arm was moved from outside since.
        near = np.all(np.abs(self._hold - measured) <= self._tolerances.start)
        begin = self._hold if near else measured
        self._goal = _Goal(goal, checked, begin - checked.positions[0], now)
        return self._report("active")

    def cancel(self, goal: str, reason: str, now: float) -> MotionStatus:
        """Begin to bring the robot to rest along its path. An empty id means whatever runs.

        The state stays active, with a message, until the robot is at rest, then it is cancelled. A goal that is over
        keeps its state, one that was never heard of has none.
        """
        running = self._goal
        if running is None or goal not in ("", running.id):
            if goal == "":
                return self.status
            unknown = f"no goal {goal!r} is known"
            return self._memory.get(goal) or MotionStatus(
                id=goal, error="unknown_goal", message=unknown, source=self._name
            )
        if running.stop is None:
            running.stop = plan_stop(running.trajectory, running.time, self._limits)
            running.reason = reason
        return self._report("active", message=f"stopping: {running.reason}")

    def update(self, now: float, measured: Vector, measured_velocity: Vector) -> tuple[Vector, Vector]:
        """The set-points (dof,) [rad], [rad/s] for now. `status` says what became of the goal.

        Args:
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
            measured_velocity: (dof,) [rad/s].
        """
        if self._fault:  # the arm may have sagged meanwhile
            self._fault, self._hold = "", measured.copy()
        goal = self._goal
        if goal is None:
            return self._hold, 0.0 * self._hold
        self._judge(goal, now, measured, measured_velocity)
        if self._goal is None:
            return self._hold, 0.0 * self._hold
        elapsed = min(max(now - goal.last, 0.0), LARGEST_STEP)
        goal.last = now
        goal.time += goal.stop.advance(elapsed) if goal.stop else elapsed
        over = goal.time >= goal.trajectory.duration or (goal.stop is not None and goal.stop.done)
        if over and goal.ended is None:
            goal.ended = now
        self._hold, velocity = goal.set_point()
        if goal.stop is None:
            self._report("active")
        return self._hold, velocity

    def abort(self, error: str, message: str, measured: Vector | None = None, source: str = "") -> None:
        """End the running goal and hold where the robot is."""
        if measured is not None:
            self._hold = measured.copy()
        if self._goal is not None:
            self._finish("aborted", error, message, source)

    def fault(self, message: str) -> None:
        """End the running goal: the hardware does not work. Goals are rejected until `update` is called again."""
        self._fault = message
        self.abort("hardware_fault", message, source="hardware")

    def _judge(self, goal: _Goal, now: float, measured: Vector, velocity: Vector) -> None:
        """End the goal when it is reached, or the robot is too far from the newest set-point."""
        allowed = self._tolerances
        off = np.abs(measured - self._hold)
        j = int(np.argmax(off))
        name = self._limits.names[j]
        if off[j] > allowed.path:
            return self.abort("path_tolerance", f"{name} is {off[j]:.4f} rad off its path (tolerance {allowed.path:g})",
                              measured)
        if goal.ended is None:
            return None
        rest = bool(np.all(np.abs(velocity) <= allowed.stopped_velocity))
        waited = now - goal.ended > allowed.goal_time
        if goal.stop is not None:
            if rest or waited:
                self._finish("cancelled", "cancelled", goal.reason)
        elif rest and off[j] <= allowed.goal:
            self._finish("succeeded")
        elif waited:
            what = f"{off[j]:.4f} rad off its goal (tolerance {allowed.goal:g})" if rest else "still moving"
            self.abort("goal_tolerance", f"{name} is {what} {allowed.goal_time:g} s after the end", measured)
        return None

    def _report(self, state: GoalState, error: str = "", message: str = "", source: str = "") -> MotionStatus:
        assert self._goal is not None
        progress = 1.0 if state == "succeeded" else min(self._goal.time / self._goal.trajectory.duration, 1.0)
        self.status = MotionStatus(
            id=self._goal.id, state=state, progress=progress, error=error, message=message, source=source or self._name
        )
        return self._memory.put(self._goal.id, self.status)

    def _finish(self, state: GoalState, error: str = "", message: str = "", source: str = "") -> None:
        self._report(state, error, message, source)
        self._goal = None
