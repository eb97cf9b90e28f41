"""Point to point with synchronised trapezoidal profiles of all joints, as in an industrial controller."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.joint_goals import joint_goals
from common.planning.joint_paths import blocked_edge, first_success
from common.planning.problem import Cancel, Problem, Result
from common.planning.trajectory import TimedPath, at_rest
from common.planning.waypoint_timing import LIMIT_SHARE

Array = NDArray[np.float64]


class Options(Parameters):
    """How hard the joints brake, and how many goals they may choose from."""

    deceleration: float = Field(1.0, gt=0, le=1, description="as a share of the acceleration limits")
    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")
    steps: int = Field(40, ge=1, le=10000, description="waypoints in which a collision is counted")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return a trajectory along the straight edge to the first goal it is free to, or the obstruction."""
    goals = joint_goals(problem, cancel, wanted=options.goals)
    if isinstance(goals, Result):
        return goals
    velocity, acceleration = LIMIT_SHARE * problem.velocity, LIMIT_SHARE * problem.acceleration

    def attempt(goal: Array) -> Result:
        hit = blocked_edge(problem, goal, options.steps)
        if hit:
            return hit
        timed = synchronised(problem.start, goal, velocity, acceleration, options.deceleration * acceleration)
        return Result(trajectory=timed, fraction=1.0)

    return first_success(goals, attempt, cancel, problem)


_SHORTEST = 1e-6  # [s] between two states


@dataclass(frozen=True)
class Trapezoid:
    """Durations [s] of the three phases and the speed [1/s] in the middle one, as a share of the length per second."""

    accelerating: float
    cruising: float
    braking: float
    speed: float

    @property
    def duration(self) -> float:
        """Seconds from rest to rest."""
        return self.accelerating + self.cruising + self.braking

    def at(self, time: float) -> tuple[float, float, float]:
        """Return distance, speed and acceleration at a time [s]; at the end of a phase the acceleration of the next."""
        up, down = self.speed / self.accelerating, self.speed / self.braking
        if time < self.accelerating:
            return 0.5 * up * time**2, up * time, up
        if time < self.accelerating + self.cruising:
            return self.speed * (time - 0.5 * self.accelerating), self.speed, 0.0
        left = self.duration - time
        total = self.speed * (0.5 * self.accelerating + self.cruising + 0.5 * self.braking)
        return total - 0.5 * down * left**2, down * left, -down


def trapezoid(length: float, speed: float, acceleration: float, deceleration: float) -> Trapezoid:
    """Return the fastest profile over a length > 0 within a speed, an acceleration and a deceleration, all positive.

    A length too short to reach the speed has no middle phase: v^2 / 2a + v^2 / 2d = length.
    """
    top = min(speed, math.sqrt(2 * length / (1 / acceleration + 1 / deceleration)))
    accelerating, braking = top / acceleration, top / deceleration
    cruising = max(0.0, (length - 0.5 * top * (accelerating + braking)) / top)
    return Trapezoid(accelerating, cruising, braking, top)


def synchronised(start: Array, goal: Array, velocity: Array, acceleration: Array, deceleration: Array) -> TimedPath:
    """Return the fastest trajectory between two positions (dof,) [rad] with one profile for all joints.

    The joint that needs longest sets the times, no limit (dof,) is exceeded, and the path is a straight edge.
    """
    span = goal - start
    moving = np.abs(span) > 1e-9
    if not moving.any():
        return at_rest(start)
    span_moving = np.abs(span[moving])
    v, a, d = (float((limit[moving] / span_moving).min()) for limit in (velocity, acceleration, deceleration))
    profile = trapezoid(1.0, v, a, d)
    times = [0.0]
    for time in (profile.accelerating, profile.accelerating + profile.cruising, profile.duration):
        if time > times[-1] + _SHORTEST:
            times.append(time)
    states = np.array([profile.at(time) for time in times])
    states[-1, :2] = 1.0, 0.0
    s, ds, dds = (column[:, None] for column in states.T)
    positions = start + s * span
    positions[-1] = goal
    return TimedPath(np.array(times), positions, ds * span, dds * span)
