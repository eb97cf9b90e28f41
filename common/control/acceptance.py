"""Acceptance of goals: whether a motion may start now, from where, and whether its trajectory can be followed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from common.control.goals import MAX_SAMPLES, Assessment, ForceControl, Goal, GoalReports, possible_rate, time_at
from common.control.limiter import Limiter
from common.control.set_point_gaps import SetPointGaps
from common.control.set_points import Standstill
from common.control.trajectory import Tolerances, Trajectory, checked_trajectory
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import JointTrajectory

LONG = 3000  # points and samples of a trajectory, which cost a few milliseconds


class Acceptance:
    """Makes goals of trajectories that the arm can follow from where it is."""

    def __init__(
        self, limits: Limits, tolerances: Tolerances, limiter: Limiter, standstill: Standstill, gaps: SetPointGaps,
        reports: GoalReports, period: float,
    ) -> None:
        """Share the state of the controller, whose cycles are `period` [s] apart."""
        self._limits, self._tolerances, self._period = limits, tolerances, period
        self._limiter, self._standstill, self._gaps, self._reports = limiter, standstill, gaps, reports

    def takes_long(self, trajectory: JointTrajectory) -> bool:
        """Return whether assessing a trajectory takes longer than there is time between cycles."""
        points = trajectory.points
        seconds = points[-1].time_from_start if points else 0.0
        return len(points) + min(2 * seconds / self._period, MAX_SAMPLES) > LONG

    def assess(self, trajectory: JointTrajectory, measured: Vector, start: Vector | None = None) -> Assessment:
        """Return whether and how a trajectory can be followed from where the arm is, measured (dof,) [rad]."""
        start = (self._standstill.start_of_motion(measured) if start is None else start).copy()
        try:
            checked = checked_trajectory(trajectory, self._limits, measured, self._tolerances)
            return Assessment.of(checked, start, self._limits, self._period)
        except Refused as refusal:
            return Assessment(start, refusal=refusal)

    def goal(
        self, name: str, trajectory: JointTrajectory, now: float, measured: Vector, assessment: Assessment | None,
        running: Goal | None, force: Callable[[Trajectory, Vector], ForceControl] | None, start_at: float,
    ) -> Goal:
        """Return the goal that starts now; the arguments are those of `TrajectoryController.accept`.

        Raises:
            Refused: no motion can start now, or this one cannot be followed.
        """
        start = self._require_ready(measured, running)
        if assessment is None:
            assessment = self.assess(trajectory, measured, start)
        elif np.any(np.abs(start - assessment.start) > self._tolerances.start):
            raise Refused("busy", "the arm was moved while the trajectory was checked")
        if assessment.trajectory is None:
            assert assessment.refusal is not None
            raise assessment.refusal
        rate = 0.0 if self._reports.holds else self._reports.speed_scaling * assessment.share
        accepted = assessment.goal(name, start, now, rate, self._limits)
        accepted.force = None if force is None else force(assessment.trajectory, start)
        if start_at:
            accepted.time, accepted.start_at = time_at(now, start_at), start_at
            accepted.fastest = possible_rate(accepted, self._limits, self._period)
        if start is not self._standstill.position:
            self._standstill.locate(measured)
        self._standstill.goal_accepted()
        return accepted

    def _require_ready(self, measured: Vector, running: Goal | None) -> Vector:
        """Return where a new motion starts (dof,) [rad].

        Raises:
            Refused: no motion can start now.
        """
        still = self._standstill
        if self._reports.fault:
            raise Refused("hardware_fault", self._reports.fault)
        if running is not None:
            raise Refused("busy", f"goal {running.id!r} is still being followed")
        if self._gaps.last is None:
            still.locate(measured)
        elif still.coasting or self._gaps.locating or not self._limiter.at_rest:
            raise Refused("busy", "the arm is still coming to rest" if still.jog_velocity is None
                          else "the arm is jogged")
        still.require_followed(measured)
        return still.start_of_motion(measured)
