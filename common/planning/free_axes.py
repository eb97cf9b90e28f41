"""Joint positions that put the tool into a region, for arms that cannot choose all of its pose.

With fewer than six joints a tool that is put to a place takes the turn and the tilt that are left there. So only what a
region asks for, and only where it is not kept yet, is an equation of the search; the rest falls out as it may.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.ik import (
    POSITION_TOLERANCE,
    ROTATION_TOLERANCE,
    damped_step,
    damped_step_within,
    solve_ik,
    why_no_ik,
)
from common.planning.problem import Region
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

Array = NDArray[np.float64]

ALL = 6  # joints with which an arm chooses position, tilt and yaw
_WITHIN = 0.02  # of a bound by which the search aims within it: what is on the bound may be found outside of it
_TURNED = 1e-9  # sine of a tilt below which it has no axis
_SEEDS = 4  # from which the least tilt or yaw is looked for
_PARTS = 6  # in which bounds are narrowed then


def chooses(robot: RobotModel) -> bool:
    """Whether the arm has joints enough to choose yaw and tilt wherever it puts the tool."""
    return robot.dof >= ALL


def converge_in(robot: RobotModel, region: Region, seed: Array, iterations: int) -> Array | None:
    """Joint positions (dof,) [rad] within the limits with the TCP in a region, found from a seed; None when stuck.

    Damped least squares as in `common.planning.ik`, with one row for each of these that is not kept: position along
    the axes of world, tilt, and yaw. What is kept has no row, so that joints are free to leave it as far as it may be.
    """
    model, data, frame = robot.model, robot.data, robot.tcp_frame
    lower, upper = robot.lower, robot.upper
    q = np.clip(seed, lower, upper)
    for _ in range(iterations):
        pin.computeJointJacobians(model, data, q)
        T = pin.updateFramePlacement(model, data, frame)
        moved = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        rows = list(_left(region, np.asarray(T.rotation), np.asarray(T.translation)))
        if not rows:
            return np.asarray(q)
        jacobian = np.array([row @ moved for row, _ in rows])
        error = np.array([value for _, value in rows])
        damping = (0.05 * min(1.0, float(error @ error)) + 1e-7) * np.eye(len(rows))
        following = q + damped_step(jacobian, error, damping)
        if (following < lower).any() or (following > upper).any():
            following = damped_step_within(q, jacobian, error, damping, lower, upper)
        q = following
    return None


def _left(region: Region, R: Array, p: Array) -> Iterator[tuple[Array, float]]:
    """What of a region a pose does not keep: the part of a twist (6,), world, that changes it, and by how much."""
    target = region.T_world_tcp
    away = target[:3, 3] - p
    beyond = np.sign(away) * np.maximum(np.abs(away) - region.half_sides, 0.0)
    place = [(np.eye(6)[axis], float(beyond[axis])) for axis in range(3)]
    point = [row for axis, row in enumerate(place) if region.half_sides[axis] == 0.0 or row[1] != 0.0]
    in_place = float(np.abs(beyond).max()) < POSITION_TOLERANCE

    turned = target[:3, :3].T @ R
    tilt = math.acos(float(np.clip(turned[2, 2], -1, 1)))
    axis = np.cross(R[:, 2], target[:3, 2])
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > _TURNED else np.asarray(R[:, 0])
    # The turn that is left once the tool axis was brought back by the shortest way.
    yaw = math.atan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1])
    upright = tilt - region.tilt < ROTATION_TOLERANCE
    facing = abs(yaw) - region.yaw < ROTATION_TOLERANCE
    if in_place and upright and facing:
        return
    yield from point
    if region.tilt == 0.0:
        for across in (target[:3, 0], target[:3, 1]):
            yield _turn(across), tilt * float(axis @ across)
    elif tilt > region.tilt * (1 - _WITHIN):
        yield _turn(axis), tilt - region.tilt * (1 - _WITHIN)
    if not facing or region.yaw == 0.0:
        yield _turn(target[:3, 2]), -math.copysign(max(abs(yaw) - region.yaw * (1 - _WITHIN), 0.0), yaw)


def _turn(axis: Array) -> Array:
    return np.concatenate([np.zeros(3), axis])


def solve_in(
    robot: RobotModel, region: Region, seed: Array, *, rng: np.random.Generator | None = None, restarts: int = 0,
    iterations: int = 30, upright: bool = True,
) -> Array | None:
    """Joint positions (dof,) [rad] with the TCP in a region, from a seed; None when none was found.

    Args:
        robot: the model.
        region: where the TCP may be.
        seed: (dof,) [rad] from which the search starts.
        rng: where restarts come from; the same sequence each time when not given.
        restarts: random starts after the seed failed.
        iterations: steps from each.
        upright: without any tilt where that can be had from the seed; else with what is nearest to it.
    """
    generator = rng if rng is not None else np.random.default_rng(0)
    straight = Region(region.T_world_tcp, region.half_sides, 0.0, region.yaw)
    for number in range(restarts + 1):
        start = seed if number == 0 else generator.uniform(robot.lower, robot.upper)
        for tried in (straight, region) if region.tilt and upright else (region,):
            if (q := converge_in(robot, tried, start, iterations)) is not None:
                return q
    return None


def solve_down(
    robot: RobotModel, place: tuple[float, float, float], yaw: float, seed: Array, *, tilt: float = 0.0,
    rng: np.random.Generator | None = None, restarts: int = 0, iterations: int = 30, upright: bool = True,
) -> Array | None:
    """Joint positions (dof,) [rad] with the tool pointing down at a place (x, y, z) [m]; None when none was found.

    Args:
        robot: the model.
        place: of the TCP, world.
        yaw: of the tool [rad]; an arm that cannot choose it takes any.
        seed: (dof,) [rad] from which the search starts.
        tilt: by which the tool may be off [rad].
        rng: where restarts come from; restarts: random starts after the seed failed; iterations: steps from the seed.
        upright: as of `solve_in`.
    """
    T = tool_down(*place, yaw)
    if chooses(robot) and tilt == 0.0:
        return solve_ik(robot, T, seed, rng=rng, restarts=restarts, iterations=iterations)
    region = about(robot, T, tilt)
    return solve_in(robot, region, seed, rng=rng, restarts=restarts, iterations=2 * iterations, upright=upright)


def about(robot: RobotModel, T_world_tcp: Array, tilt: float) -> Region:
    """The region at a pose (4, 4) for what may be taken at any yaw: with a yaw of its own where the arm chooses it."""
    return Region(T_world_tcp, np.zeros(3), tilt, 0.0 if chooses(robot) else math.pi)


def why_not_in(robot: RobotModel, region: Region, seed: Array) -> str:
    """Why no joint positions put the TCP into a region, in words: too far, which limit, or which axis is not free."""
    if chooses(robot):
        return why_no_ik(robot, region.T_world_tcp, seed)
    if _somewhere(robot, region, seed) is not None:
        return "it gets there in another posture"
    T, sides = region.T_world_tcp, region.half_sides
    any_yaw, anything = (Region(T, sides, tilt, math.pi) for tilt in (region.tilt, math.pi))
    if (q := _somewhere(robot, any_yaw, seed)) is not None:
        off = _narrowed(robot, region, q, "yaw")
        return (f"with {robot.dof} joints it cannot choose yaw there: nearest is {math.degrees(off):.0f} deg, "
                f"{math.degrees(region.yaw):.0f} deg are allowed")
    if (q := _somewhere(robot, anything, seed)) is not None:
        off = _narrowed(robot, region, q, "tilt")
        return (f"with {robot.dof} joints it cannot choose tilt there: nearest is {math.degrees(off):.0f} deg, "
                f"{math.degrees(region.tilt):.0f} deg are allowed")
    away = float(np.linalg.norm(region.T_world_tcp[:3, 3] - robot.foot))
    if away > robot.reach:
        return f"it is {away:.2f} m from the first joint, {robot.reach:.2f} m is the most"
    return "the arm does not get there, however the tool is turned"


def _somewhere(robot: RobotModel, region: Region, seed: Array) -> Array | None:
    rng = np.random.default_rng(0)
    starts = [seed, *(rng.uniform(robot.lower, robot.upper) for _ in range(_SEEDS - 1))]
    return next((q for start in starts if (q := converge_in(robot, region, start, 40)) is not None), None)


def _narrowed(robot: RobotModel, region: Region, q: Array, what: str) -> float:
    """The least tilt, or the least yaw with the tilt of the region, that is found from positions q in the wider one."""
    low, high = (region.tilt, math.pi) if what == "tilt" else (region.yaw, math.pi)
    for _ in range(_PARTS):
        middle = (low + high) / 2
        tried = Region(region.T_world_tcp, region.half_sides, *(
            (middle, math.pi) if what == "tilt" else (region.tilt, middle)))
        found = converge_in(robot, tried, q, 40)
        low, high, q = (low, middle, found) if found is not None else (middle, high, q)
    return high
