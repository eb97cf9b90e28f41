"""Functions that exported programs use: parts of steps that are not one call of the client. `cell` is a blocking one.

Poses are (4, 4), of the tool centre point in world.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import messages as m
from common.client.goals import goal_of
from common.client.operator_motion import MotionFailed
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, rpy_to_matrix, tool_down, transform
from common.tasks.handling import DROP, grasp_directions
from common.tasks.palletizing import Pattern, slot_at
from common.tasks.stages import place_of
from common.time_source import monotonic

Array = NDArray[np.float64]
NEAR = 0.2  # [m] from the tool: objects that the gripper may touch when it moves back
ROOM = 0.02  # [m] by which the fingers open wider than the object


def backed(T: Array, distance: float, axis: str) -> Array:
    """Return a pose moved back along the tool's z axis, or up for the axis `world` [m]."""
    moved = T.copy()
    moved[:3, 3] += (0.0, 0.0, distance) if axis == "world" else -distance * T[:3, 2]
    return moved


def relative(T: Array, by: Sequence[float], turn: Sequence[float], frame: str) -> Array:
    """Return a pose displaced along the axes of a frame [m], and turned about the tool's own axes [rad]."""
    moved = T.copy()
    moved[:3, 3] += by if frame == "world" else T[:3, :3] @ np.array(by)
    moved[:3, :3] = T[:3, :3] @ rpy_to_matrix(*turn)
    return moved


def blended(cell: Any, *targets: Any, radius: float, straight: bool) -> m.SequenceGoal:
    """Return a goal that passes targets in one motion, with corners of a radius [m]."""
    goals = [goal_of(target) for target in targets]
    last = len(goals) - 1
    return m.SequenceGoal.model_validate({"items": [
        {"goal": goal, "straight": straight, "blend_radius": radius if number < last else 0.0}
        for number, goal in enumerate(goals)]})


def ids(cell: Any, names: Sequence[str]) -> list[str]:
    """Return the ids of the objects with these ids or classes."""
    return [each.id for each in cell.planning_scene().objects if each.id in names or each.kind in names]


def near(cell: Any) -> list[str]:
    """Return the ids of movable objects near the tool."""
    at = cell.arm.pose()[:3, 3]
    return [each.id for each in cell.objects() if math.dist(place_of(each.pose), at) < NEAR]


def require_holding(state: m.GripperState, *, holding: bool = True) -> None:
    """Require that the gripper holds something, or nothing.

    Raises:
        MotionFailed: it is otherwise.
    """
    if state.holding is not holding or (holding and state.outcome in ("too_wide", "too_narrow", "empty")):
        raise MotionFailed("grasp", state.message or f"the gripper holds {'nothing' if holding else 'something'}")


def pick(
    cell: Any, *, closing_axis: str, approach: float, lowest: float, kind: str = "", role: str = "target",
    object: str = "", force: float = 0.0, timeout: float = 5.0, outside: Sequence[Pattern] = (), **how: Any,
) -> None:
    """Grasp the fitting object that is nearest to the tool from above, and lift it.

    Raises:
        MotionFailed: none is seen, or it was not grasped.
    """
    ends, found = monotonic() + timeout, list[m.CollisionObject]()
    while not found:
        found = [each for each in cell.objects() if each.role == role and kind in ("", each.kind)
                 and object in ("", each.id)
                 and not any(slot_at(pattern, place_of(each.pose)) for pattern in outside)]
        if not found and monotonic() > ends:
            raise MotionFailed("not_seen", f"no {object or kind or 'object'} with role {role} is seen")
    at = cell.arm.pose()[:2, 3]
    thing = min(found, key=lambda each: math.dist(place_of(each.pose)[:2], at))
    widest = cell.arm.description().gripper_width
    yaw, width = grasp_directions(thing, closing_axis, widest)[0]
    x, y, z = place_of(thing.pose)
    T = tool_down(x, y, max(z, lowest), yaw)
    cell.gripper.move(min((width or widest) + ROOM, widest))
    cell.arm.move(backed(T, approach, "world"), **how)
    cell.arm.move(T, straight=True, touch=[thing.id], **how)
    closed = cell.gripper.close(force or thing.grip_effort, expected=width, tolerance=0.01, mass=thing.mass)
    require_holding(closed)
    cell.arm.move(backed(T, approach, "world"), straight=True, **how)


def place(cell: Any, T: Array, distance: float, **how: Any) -> None:
    """Place what is held at a pose, from above it, and move back [m]."""
    state, widest = cell.gripper.state(), cell.arm.description().gripper_width
    require_holding(state)
    cell.arm.move(backed(T, distance, "world"), **how)
    held = [each.object.id for each in cell.planning_scene().attached]
    pairs = [(name, other) for name in held for other in _near(cell, T)]
    cell.arm.move(T, straight=True, allowed_collisions=pairs, **how)
    require_holding(cell.gripper.move(min(state.width + ROOM, widest)), holding=False)
    cell.arm.move(backed(T, distance, "world"), straight=True, touch=near(cell), **how)


def over_slot(cell: Any, slot: m.Pose, height: float) -> Array:
    """Return the pose that places the held item at a slot of a pallet; `height` [m] for one that no camera saw."""
    T_slot = backed(pose_to_matrix(slot), DROP, "world")
    attached = cell.planning_scene().attached
    if attached:
        held = invert(pose_to_matrix(attached[0].object.pose))
        turns = [T_slot @ transform(rpy_to_matrix(0, 0, turn), (0, 0, 0)) @ held for turn in (0.0, math.pi)]
        return max(turns, key=lambda T: float(T[0, 0]))
    yaw = math.remainder(math.atan2(T_slot[1, 0], T_slot[0, 0]), math.pi)
    return transform(rpy_to_matrix(math.pi, 0.0, yaw), T_slot[:3, 3] + (0.0, 0.0, height))


def call(function: Callable[..., Any], timeout: float, **arguments: Any) -> str:
    """Return the outcome of a function, which may be asynchronous.

    Raises:
        TimeoutError: it takes longer than `timeout` [s].
    """
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        work = (lambda: asyncio.run(function(**arguments))) if inspect.iscoroutinefunction(function) else (
            lambda: function(**arguments))
        result = pool.submit(work).result(timeout)
    if isinstance(result, bool):
        return "succeeded" if result else "failed"
    return "succeeded" if result is None else str(result)


def _near(cell: Any, T: Array) -> list[str]:
    at = matrix_to_pose(T)
    return [each.id for each in cell.objects() if math.dist(place_of(each.pose), place_of(at)) < NEAR]
