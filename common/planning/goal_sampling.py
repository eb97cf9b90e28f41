"""Poses of a goal region, and free joint positions that put the TCP into it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.contact_rules import Pair
from common.planning.ik import controls_full_pose, solve_ik, solve_region_ik
from common.planning.problem import Cancel, Problem, Region, Result
from common.robot.transforms import invert, transform

Array = NDArray[np.float64]


@dataclass
class GoalSamples:
    """Free positions (dof,) [rad], nearest to the start first, and why the others were dropped."""

    goals: list[Array] = field(default_factory=list)
    reached: int = 0
    violation: str = ""  # of a tool constraint, by the first position that violates one
    colliding: Pair | None = None

    def failure(self, stop: str) -> Result:
        """Return why there is no goal; `stop`: cancelled or timeout, if that ended the search."""
        if stop:
            return Result(error=stop, message="planning ended while goals were sampled")
        if self.violation and not self.colliding:
            message = f"no pose of {self.reached} found in the goal region meets the constraints; {self.violation}"
            return Result(error="goal_violates_constraint", message=message)
        if self.colliding:
            one, other = self.colliding
            what = f"collide or violate a constraint ({self.violation})" if self.violation else "collide"
            message = f"all {self.reached} poses found in the goal region {what}; {one} collides with {other}"
            return Result(error="goal_in_collision", message=message, colliding=self.colliding)
        return Result(error="no_ik", message="no pose of the goal region can be reached")


def sample_pose(region: Region, rng: np.random.Generator) -> Array:
    """Return (4, 4) T_world_tcp, uniform in the region's box, tilt and yaw."""
    axis = rng.uniform(-math.pi, math.pi)
    tilt = pin.exp3(rng.uniform(0, 1) * region.tilt * np.array([math.cos(axis), math.sin(axis), 0.0]))
    turn = pin.exp3(rng.uniform(-1, 1) * region.yaw * np.array([0.0, 0.0, 1.0]))
    T = region.T_world_tcp
    return transform(T[:3, :3] @ tilt @ turn, T[:3, 3] + rng.uniform(-1, 1, 3) * region.half_sides)


def nearest_pose_in(region: Region, T_world_tcp: Array) -> Array:
    """Return the (4, 4) pose of a region near another pose: position, tilt and yaw are each clipped to the bounds."""
    T = region.T_world_tcp
    low, high = T[:3, 3] - region.half_sides, T[:3, 3] + region.half_sides
    turned = T[:3, :3].T @ T_world_tcp[:3, :3]
    tilt = math.acos(float(np.clip(turned[2, 2], -1, 1)))
    axis = np.array([-turned[1, 2], turned[0, 2], 0.0])
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    flat = pin.exp3(tilt * axis).T @ turned
    yaw = min(max(math.atan2(flat[1, 0], flat[0, 0]), -region.yaw), region.yaw)
    turn = pin.exp3(np.array([0.0, 0.0, yaw]))
    return transform(T[:3, :3] @ pin.exp3(min(tilt, region.tilt) * axis) @ turn,
                     np.clip(T_world_tcp[:3, 3], low, high))


def distance_outside(region: Region, T_world_tcp: Array) -> float:
    """Return how far a (4, 4) pose lies outside the region in its worst direction [m], [rad]; 0 or less if inside."""
    tilt, yaw = tilt_and_yaw_from(region, T_world_tcp)
    away = np.abs(T_world_tcp[:3, 3] - region.T_world_tcp[:3, 3]) - region.half_sides
    return max(float(away.max()), tilt - region.tilt, abs(yaw) - region.yaw)


def tilt_and_yaw_from(region: Region, T_world_tcp: Array) -> tuple[float, float]:
    """Return tilt and yaw [rad] of a (4, 4) pose relative to that of a region."""
    T = invert(region.T_world_tcp) @ T_world_tcp
    # The yaw is the turn that remains after the shortest rotation has aligned the tool axes.
    return math.acos(float(np.clip(T[2, 2], -1, 1))), math.atan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])


def sample_goals(problem: Problem, goal: Array | Region, cancel: Cancel, *, wanted: int, tries: int) -> GoalSamples:
    """Return up to `wanted` free goal positions: at a region's own pose first, then at others drawn from it."""
    samples = GoalSamples()
    if isinstance(goal, Region):
        _draw(problem, goal, cancel, samples, wanted, tries)
    else:
        _check(problem, goal, samples)
    samples.goals.sort(key=lambda goal: min_travel_time(problem.start, goal, problem.velocity))
    return samples


def _check(problem: Problem, q: Array, samples: GoalSamples) -> None:
    """Add q (dof,) [rad] to the samples: as a goal if it is free, else as the reason why it is not."""
    samples.reached += 1
    violation = problem.world.constraints.state_violation(q) if problem.world.constraints else ""
    if violation:
        samples.violation = samples.violation or violation
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
        if point or controls_full_pose(robot):
            q = solve_ik(robot, T, seed, rng=rng, restarts=5 if attempt == 0 else 1)
        else:
            there = replace(region, T_world_tcp=transform(region.T_world_tcp[:3, :3], T[:3, 3]), half_sides=np.zeros(3))
            q = solve_region_ik(robot, there, seed, rng=rng, restarts=1)
        if q is not None:
            _check(problem, q, samples)


def min_travel_time(a: Array, b: Array, velocity: Array) -> float:
    """Return the least time [s] of the straight edge: that of the slowest joint at its velocity limit."""
    return float((np.abs(b - a) / velocity).max())
