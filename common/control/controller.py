"""The trajectory controller: takes goals, gives set-points, judges how well they are followed. No clock of its own.

An action's life: rejected at once, or active and then succeeded, aborted or cancelled. One goal at a time. While the
robot is held its goal stays active, at rest on its path; one that comes meanwhile is accepted and waits at its start.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from common.control.checks import Tolerances, checked_trajectory
from common.control.goals import REMEMBERED, GoalMemory
from common.control.trajectory import Trajectory, next_rate, way
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import GoalState, Holder, Inhibit, JointTrajectory, MotionStatus

LARGEST_STEP = 0.1  # cell time [s]: after a stall of the loop a trajectory goes on where it was, instead of jumping
BLEND_TIME = 0.3  # the difference between the robot's and the trajectory's start fades in this time [s]


@dataclass
class _Goal:
    """The goal that moves the robot. `time` is on the trajectory's own time axis [s], which passes at `rate`."""

    id: str
    trajectory: Trajectory
    offset: Vector
    last: float  # cell time of the newest set-point
    rate: float
    time: float = 0.0
    stopping: bool = False
    reason: str = ""
    ended: float | None = None  # cell time at which the set-points came to rest

    def at(self, time: float) -> tuple[Vector, Vector]:
        """Positions [rad] and their change per second of the trajectory (dof,), blended from where the robot was."""
        q, dq = self.trajectory.at(time)
        blend = min(BLEND_TIME, self.trajectory.duration)
        if time >= blend:
            return q, dq
        u = time / blend
        left, slope = 1 - u**3 * (10 - 15 * u + 6 * u**2), -30 * u**2 * (1 - u) ** 2 / blend
        return q + left * self.offset, dq + slope * self.offset

    @property
    def progress(self) -> float:
        """The share of the trajectory that is behind it."""
        return min(self.time / self.trajectory.duration, 1.0)

    def advance(self, seconds: float, target: float, acceleration: Vector) -> None:
        """Move on by cell time [s], bringing the rate towards the target."""
        rate = next_rate(self.at, self.time, self.rate, target, seconds, acceleration)
        self.time += way(self.rate, rate, seconds)
        self.rate = rate


class TrajectoryController:
    """Follows one trajectory at a time, and holds still between them."""

    def __init__(
        self, limits: Limits, start: Vector, tolerances: Tolerances | None = None, remember: int = REMEMBERED,
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
        self._holds: dict[Holder, str] = {}  # the reasons, by who holds the robot
        self._status = MotionStatus()
        self.speed_scaling = 1.0
        self.inhibits: list[Inhibit] = []  # that reports tell of

    @property
    def status(self) -> MotionStatus:
        """What became of the newest goal, and whether and how fast the robot may move."""
        return self._as_of_now(self._status)

    @property
    def goal(self) -> str:
        """Id of the goal that moves the robot; empty when there is none."""
        return self._goal.id if self._goal else ""

    def _as_of_now(self, status: MotionStatus) -> MotionStatus:
        now: dict[str, object] = {
            "held": bool(self._holds), "held_by": sorted(self._holds), "speed_scaling": self.speed_scaling,
            "inhibits": self.inhibits,
        }
        if self._holds and status.state != "active" and not status.message:
            now["message"] = _told("held", self._holds.values())
        return status.model_copy(update=now)

    def accept(
        self, goal: str, trajectory: JointTrajectory, now: float, measured: Vector, objection: Refused | None = None
    ) -> MotionStatus:
        """The state of the goal: active, or rejected with code and message; for a known id what became of it.

        Args:
            goal: id of the goal, minted by the requester. The same id never moves the robot twice.
            trajectory: what to follow.
            now: cell time [s].
            measured: where the robot is, (dof,) [rad].
            objection: what speaks against a new goal from the start.
        """
        known = self._memory.get(goal)
        if known is not None:
            return self._as_of_now(known)
        try:
            if objection is not None:
                raise objection
            if self._fault:
                raise Refused("hardware_fault", self._fault)
            if self._goal is not None:
                raise Refused("busy", f"goal {self._goal.id!r} is still being followed")
            checked = checked_trajectory(trajectory, self._limits, measured, self._tolerances)
        except Refused as refusal:
            rejected = MotionStatus(
                id=goal, state="rejected", error=refusal.code, message=str(refusal), source=self._name
            )
            return self._as_of_now(self._memory.put(goal, rejected))
        # Go on from the set-point, unless the arm was moved from outside since.
        near = np.all(np.abs(self._hold - measured) <= self._tolerances.start)
        begin = self._hold if near else measured
        rate = 0.0 if self._holds else self.speed_scaling
        self._goal = _Goal(goal, checked, begin - checked.positions[0], now, rate)
        return self._report("active", message=self._holding(self._goal))

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
            return self._as_of_now(self._memory.get(goal) or MotionStatus(
                id=goal, error="unknown_goal", message=unknown, source=self._name
            ))
        if not running.stopping:
            running.stopping, running.reason = True, reason
        return self._report("active", message=f"stopping: {running.reason}")

    def hold(self, hold: bool, reason: str, by: Holder = "person") -> MotionStatus:
        """The status: begin to bring the robot to rest on its path, or let it go on, unless another holds it."""
        if hold:
            self._holds[by] = reason
        else:
            self._holds.pop(by, None)
        if self._goal is not None and not self._goal.stopping:
            return self._report("active", message=self._holding(self._goal))
        return self.status

    def knows(self, goal: str) -> bool:
        """Whether a goal was heard of."""
        return self._memory.get(goal) is not None

    def _holding(self, goal: _Goal) -> str:
        """What there is to say of a goal about being held."""
        if not self._holds:
            return ""
        return _told("held" if goal.rate == 0.0 else "coming to rest", self._holds.values())

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
        braking = goal.stopping or bool(self._holds)
        goal.advance(elapsed, 0.0 if braking else self.speed_scaling,
                     self._limits.braking if braking else self._limits.acceleration)
        over = goal.time >= goal.trajectory.duration or (goal.stopping and goal.rate == 0.0)
        if over and goal.ended is None:
            goal.ended = now
        self._hold, change = goal.at(goal.time)
        if not goal.stopping:
            message = self._holding(goal)
            if message == self._status.message:
                self._status.progress = goal.progress  # all else of it is as it was
                self._memory.put(goal.id, self._status)
            else:
                self._report("active", message=message)
        return self._hold, change * goal.rate

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
        if goal.stopping:
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
        progress = 1.0 if state == "succeeded" else self._goal.progress
        self._status = MotionStatus(
            id=self._goal.id, state=state, progress=progress, error=error, message=message, source=source or self._name
        )
        return self._as_of_now(self._memory.put(self._goal.id, self._status))

    def _finish(self, state: GoalState, error: str = "", message: str = "", source: str = "") -> None:
        self._report(state, error, message, source)
        self._goal = None


def _told(what: str, reasons: Iterable[str]) -> str:
    return ": ".join([what, *filter(None, ["; ".join(filter(None, reasons))])])
