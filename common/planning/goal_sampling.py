"""Joint positions that put the TCP somewhere in a goal region."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.collision import Pair
from common.planning.free_axes import chooses, solve_in
from common.planning.ik import solve_ik
from common.planning.problem import Cancel, Problem, Region, Result
from common.robot.transforms import invert, transform

Array = NDArray[np.float64]


@dataclass
class GoalSamples:
    """Free positions (dof,) [rad], nearest to the start first, and what was in the way of the others."""

    goals: list[Array] = field(default_factory=list)
    reached: int = 0
    left: str = ""  # what the first of those violated that break a constraint of the tool
    colliding: Pair | None = None

    def failure(self, stop: str) -> Result:
        """Why there is no goal; `stop`: cancelled or timeout where that ended the search."""
        if stop:
            return Result(error=stop, message="planning was ended while goals were sampled")
        if self.left and not self.colliding:
            message = f"none of {self.reached} poses found in the goal region will do; {self.left}"
            return Result(error="goal_violates_constraint", message=message)
        if self.colliding:
            one, other = self.colliding
            what = f"collide, or else {self.left}" if self.left else "collide"
            message = f"all {self.reached} poses found in the goal region {what}; {one} collides with {other}"
            return Result(error="goal_in_collision", message=message, colliding=self.colliding)
        return Result(error="no_ik", message="no pose of the goal region can be reached")


def sample_pose(region: Region, rng: np.random.Generator) -> Array:
    """(4, 4) T_world_tcp, uniform in the region's box, tilt and yaw."""
    axis = rng.uniform(-math.pi, math.pi)
    tilt = pin.exp3(rng.uniform(0, 1) * region.tilt * np.array([math.cos(axis), math.sin(axis), 0.0]))
    turn = pin.exp3(rng.uniform(-1, 1) * region.yaw * np.array([0.0, 0.0, 1.0]))
    T = region.T_world_tcp
    return transform(T[:3, :3] @ tilt @ turn, T[:3, 3] + rng.uniform(-1, 1, 3) * region.half_sides)


def missed_by(region: Region, T_world_tcp: Array) -> float:
    """How far a (4, 4) pose lies outside of the region, in its worst direction [m], [rad]; 0 and less for inside."""
    tilt, yaw = turned_from(region, T_world_tcp)
    away = np.abs(T_world_tcp[:3, 3] - region.T_world_tcp[:3, 3]) - region.half_sides
    return max(float(away.max()), tilt - region.tilt, abs(yaw) - region.yaw)


def turned_from(region: Region, T_world_tcp: Array) -> tuple[float, float]:
    """Tilt and yaw [rad] of a (4, 4) pose from that of a region."""
    T = invert(region.T_world_tcp) @ T_world_tcp
    # The yaw is the turn that is left once the tool axis was brought back by the shortest way.
    return math.acos(float(np.clip(T[2, 2], -1, 1))), math.atan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])


def sample_goals(problem: Problem, goal: Array | Region, cancel: Cancel, *, wanted: int, tries: int) -> GoalSamples:
    """Up to `wanted` free goal positions: a region's own pose first, then others drawn from the region."""
    samples = GoalSamples()
    if isinstance(goal, Region):
        _draw(problem, goal, cancel, samples, wanted, tries)
    else:
        _look_at(problem, goal, samples)
    samples.goals.sort(key=lambda goal: least_time(problem.start, goal, problem.velocity))
    return samples


def _look_at(problem: Problem, q: Array, samples: GoalSamples) -> None:
    samples.reached += 1
    left = problem.world.constraints.wrong_at(q) if problem.world.constraints else ""
    if left:
        samples.left = samples.left or left
    elif problem.world.collides(q):
        samples.colliding = samples.colliding or problem.world.colliding_pair(q)
    else:
        samples.goals.append(q)


def _draw(problem: Problem, region: Region, cancel: Cancel, samples: GoalSamples, wanted: int, tries: int) -> None:
    robot, rng = problem.robot, problem.rng
    point = not region.half_sides.any() and region.tilt == 0 and region.yaw == 0
    for attempt in range(tries):
        if len(samples.goals) >= wanted or cancel.reason(problem):
            break
        T = region.T_world_tcp if attempt == 0 or point else sample_pose(region, rng)
        seed = problem.start if attempt == 0 or (attempt % 2 and not point) else rng.uniform(robot.lower, robot.upper)
        if point or chooses(robot):
            q = solve_ik(robot, T, seed, rng=rng, restarts=5 if attempt == 0 else 1)
        else:
            there = replace(region, T_world_tcp=transform(region.T_world_tcp[:3, :3], T[:3, 3]), half_sides=np.zeros(3))
            q = solve_in(robot, there, seed, rng=rng, restarts=1)
        if q is not None:
            _look_at(problem, q, samples)


def least_time(a: Array, b: Array, velocity: Array) -> float:
    """Seconds that the straight edge takes at least: the slowest joint at its velocity limit."""
    return float((np.abs(b - a) / velocity).max())
