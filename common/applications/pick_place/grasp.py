"""Where the hand goes to take a ball, and which way it is turned so that its fingers clear the neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Container, Parameters, Tunable

Array = NDArray[np.float64]


class HandShape(Parameters):
    """The open fingers as seen from above: two rectangles beside the object, in the frame of the tool centre point."""

    finger_inner: Tunable[float] = Field(0.040, gt=0, le=0.2, description="centre to inner finger face, open [m]")
    finger_outer: Tunable[float] = Field(
        0.056, gt=0, le=0.2, description="centre to outer end of a finger tip, open [m]"
    )
    finger_half_width: Tunable[float] = Field(0.011, gt=0, le=0.1, description="half the width of a finger tip [m]")
    min_clearance: Tunable[float] = Field(
        0.003, ge=0, le=0.05, description="least gap between a finger and a neighbour [m]"
    )
    yaw_count: Tunable[int] = Field(8, ge=1, le=36, description="orientations tried, spread over half a turn")


def yaw_candidates(count: int) -> list[float]:
    """Yaws [rad] in (-pi/2, pi/2], from the smallest turn to the largest; a parallel gripper repeats after pi."""
    step = math.pi / count
    yaws = [k * step if k * step <= math.pi / 2 + 1e-9 else k * step - math.pi for k in range(count)]
    return sorted(yaws, key=lambda yaw: (abs(yaw), -yaw))


def finger_clearance(
    shape: HandShape, center: Sequence[float], yaw: float, neighbours: Sequence[Sequence[float]], radius: float,
    container: Container | None = None,
) -> float:
    """Least gap [m] between the open fingers and any neighbour, negative when they overlap.

    The fingers open along the tool's y axis, which for the tool pointing down and yaw 0 is the -y axis of the world.

    Args:
        shape: the fingers.
        center: (x, y) of the object to take [m], world.
        yaw: of the tool about world z [rad].
        neighbours: (x, y) of other balls [m], world.
        radius: of the balls [m].
        container: an open box whose walls must be cleared as well.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    half_length = (shape.finger_outer - shape.finger_inner) / 2
    middle = (shape.finger_outer + shape.finger_inner) / 2
    best = math.inf
    for x, y in neighbours:
        dx, dy = x - center[0], y - center[1]
        lateral, along = c * dx + s * dy, -s * dx + c * dy
        gap_lateral = max(abs(lateral) - shape.finger_half_width, 0.0)
        gap_along = max(abs(abs(along) - middle) - half_length, 0.0)
        best = min(best, math.hypot(gap_lateral, gap_along) - radius)
    if container is not None:
        best = min(best, _container_gap(shape, center, c, s, container))
    return best


def _container_gap(shape: HandShape, center: Sequence[float], c: float, s: float, container: Container) -> float:
    """Gap between the corners of the fingers and the container's outer square, negative inside."""
    best = math.inf
    for along in (-shape.finger_outer, -shape.finger_inner, shape.finger_inner, shape.finger_outer):
        for lateral in (-shape.finger_half_width, shape.finger_half_width):
            x = center[0] + c * lateral - s * along - container.x
            y = center[1] + s * lateral + c * along - container.y
            dx, dy = abs(x) - container.half_side, abs(y) - container.half_side
            inside = min(max(dx, dy), 0.0)
            best = min(best, math.hypot(max(dx, 0.0), max(dy, 0.0)) + inside)
    return best


def grasp_yaws(
    shape: HandShape, center: Sequence[float], neighbours: Sequence[Sequence[float]], radius: float,
    container: Container | None = None,
) -> list[float]:
    """Yaws [rad] with clear fingers, the least turn first; empty when the neighbours leave no room."""
    near = [n for n in neighbours if math.dist(n[:2], center[:2]) < shape.finger_outer + 2 * radius + 0.05]
    near_xy = [(n[0], n[1]) for n in near]
    return [
        yaw
        for yaw in yaw_candidates(shape.yaw_count)
        if finger_clearance(shape, center, yaw, near_xy, radius, container) >= shape.min_clearance
    ]
