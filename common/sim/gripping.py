"""What the gripper of the kinematic world holds: between its fingers, or on its suction cup."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig, SuctionCup
from common.robot.transforms import invert
from common.sim.bodies import Body
from common.sim.interface import GraspTolerances
from common.sim.objects import Solid

Array = NDArray[np.float64]

TOUCH = 1e-6  # [m]
LIP_POINTS = 8  # on the ring of a suction cup
LINES = 5  # sampled across a finger pad to find the object between the fingers


def pressed_ends(
    gripper: GripperConfig | None, allowed: GraspTolerances, body: Body, T_world_tcp: Array, width: float,
    before: tuple[float, float] | None,
) -> tuple[float, float] | None:
    """Ends along tool y [m] of the part of a body between the pads; None if it is not between them.

    A body that was clear of both fingers stays between them: the closing finger pushes it to the center.

    Args:
        gripper: fingers or cup; None: unknown fingers.
        allowed: grasp tolerances.
        body: the candidate.
        T_world_tcp: (4, 4) of a tool whose fingers close along its y axis.
        width: between the fingers [m].
        before: ends in the previous cycle; None if it was not between them.
    """
    if gripper is not None and gripper.cup is not None:
        half = gripper.held_width / 2
        return (-half, half) if lies_on(gripper.cup, body.solid, invert(T_world_tcp) @ body.T) else None
    solid = body.solid
    reach = allowed.across + allowed.along + max(width / 2, solid.reach) + solid.reach
    if abs(body.T[2, 3] - T_world_tcp[2, 3]) > reach:
        return None
    offset = body.T[:3, 3] - T_world_tcp[:3, 3]
    if math.hypot(*offset.tolist()) > reach:
        return None
    if solid.shape == "sphere":
        x, y, z = T_world_tcp[:3, :3].T @ offset
        if abs(x) > allowed.across or abs(z) > allowed.along:
            return None
        low, high, half = float(y - solid.radius), float(y + solid.radius), solid.radius
        fits, near = abs(y) <= width / 2 - half + allowed.sideways, abs(y) < max(width / 2, half)
    else:
        ends = _pressed(solid, invert(T_world_tcp) @ body.T, width, allowed)
        if ends is None:
            return None
        # The closing finger may cover an end by pushing it.
        low, high = ends if before is None or ends[1] - ends[0] >= before[1] - before[0] else before
        half = (high - low) / 2
        fits = low >= -width / 2 - allowed.sideways and high <= width / 2 + allowed.sideways
        near = abs(low + high) / 2 < max(width / 2, half)
    enters = width / 2 >= half and fits
    return (low, high) if enters or (before is not None and near) else None


def lies_on(cup: SuctionCup, solid: Solid, T_tcp_object: Array) -> bool:
    """Whether the complete lip of a cup lies on a solid: center and ring meet it within the give of the lip."""
    around = np.linspace(0.0, 2 * math.pi, LIP_POINTS, endpoint=False)
    lip = np.vstack([(0.0, 0.0), cup.lip_radius * np.column_stack([np.cos(around), np.sin(around)])])
    if solid.shape == "sphere":
        x, y, z = T_tcp_object[:3, 3]
        inside = solid.radius**2 - ((lip - (x, y)) ** 2).sum(axis=1)
        if (inside <= 0).any():
            return False
        near = z - np.sqrt(inside)
    else:
        # Along the tool's z axis, which is the y axis of lines through (x, -y).
        T_along_tcp = np.eye(4)
        T_along_tcp[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
        spans = solid.spans(T_along_tcp @ T_tcp_object, lip * (1.0, -1.0))[: len(lip)]
        if any(not len(span) for span in spans):
            return False
        near = np.array([span[:, 0].min() for span in spans])
    return bool((np.abs(near) <= cup.give).all())


def _pressed(
    solid: Solid, T_tcp_object: Array, width: float, allowed: GraspTolerances
) -> tuple[float, float] | None:
    """Ends along tool y [m] of a solid between the pads; None if the line between their centers misses it."""
    if not solid.may_meet(T_tcp_object):
        return None
    x, z = (np.linspace(-half, half, LINES) for half in (allowed.across, allowed.along))
    lines = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    spans = solid.spans(T_tcp_object, lines)
    center = spans[len(lines) // 2]
    if not (np.abs(center).min(axis=1) < width / 2).any() and not ((center[:, 0] < 0) & (center[:, 1] > 0)).any():
        return None
    parts = sorted(tuple(span) for found in spans for span in found.tolist())
    merged: list[list[float]] = []
    for low, high in parts:
        if merged and low <= merged[-1][1] + 1e-4:
            merged[-1][1] = max(merged[-1][1], high)
        else:
            merged.append([low, high])
    inside = [part for part in merged if part[0] <= width / 2 + TOUCH and part[1] >= -width / 2 - TOUCH]
    return (inside[0][0], inside[-1][1]) if inside else None
