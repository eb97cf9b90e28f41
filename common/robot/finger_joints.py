"""Positions of a gripper's joints by its width."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig

TINY = 1e-5  # change of the width from which velocities are computed [m]


def driven_position(gripper: GripperConfig, width: float) -> float:
    """Return the position of the driven joint [rad or m] at a width [m]: half of it beyond `closed`, or an angle.

    The pads move with the ends of the linkage's bars, sideways by length * sin(open_angle - a).
    """
    if gripper.travel:
        return _between(gripper, 0, 1, width)
    if (jaw := gripper.jaw) is not None:
        sine = math.sin(jaw.angle) + width / jaw.radius
        return jaw.closed + jaw.opens * (math.asin(min(max(sine, -1.0), 1.0)) - jaw.angle)
    bars = gripper.linkage
    if bars is None:
        return gripper.closed + width / 2
    sine = math.sin(bars.open_angle - bars.closed) + width / (2 * bars.length)
    return bars.open_angle - math.asin(min(max(sine, -1.0), 1.0))


def width_at(gripper: GripperConfig, position: float) -> float:
    """Return the width [m] at a position of the driven joint [rad or m]: the inverse of `driven_position`."""
    if gripper.travel:
        return _between(gripper, 1, 0, position)
    if (jaw := gripper.jaw) is not None:
        turned = jaw.opens * (position - jaw.closed)
        return jaw.radius * (math.sin(jaw.angle + turned) - math.sin(jaw.angle))
    bars = gripper.linkage
    if bars is None:
        return 2 * (position - gripper.closed)
    return 2 * bars.length * (math.sin(bars.open_angle - position) - math.sin(bars.open_angle - bars.closed))


def measured_width(gripper: GripperConfig | None, names: Sequence[str], positions: Sequence[float]) -> float | None:
    """Return the width [m] by positions of named joints; None without a gripper, or if its joints are missing."""
    if gripper is None or not gripper.joints or gripper.joints[0] not in names:
        return None
    width = width_at(gripper, positions[list(names).index(gripper.joints[0])])
    return min(max(width, 0.0), gripper.max_width)


def finger_positions(gripper: GripperConfig, width: float) -> list[float]:
    """Return positions [rad or m] of the gripper's joints, in their order, at a width [m]."""
    if gripper.travel:
        return [_between(gripper, 0, column + 1, width) for column in range(len(gripper.joints))]
    driven = driven_position(gripper, width)
    return [factor * driven for factor, _ in finger_couplings(gripper)]


def _between(gripper: GripperConfig, known: int, wanted: int, value: float) -> float:
    """Return a column of the travel, interpolated at a value of another one that grows or falls."""
    rows = sorted(gripper.travel, key=lambda row: row[known])
    return float(np.interp(value, [row[known] for row in rows], [row[wanted] for row in rows]))


def finger_velocities(gripper: GripperConfig, width: float, rate: float) -> list[float]:
    """Return velocities [rad/s or m/s] of the gripper's joints at a width [m] that changes at a rate [m/s]."""
    if gripper.travel:
        ends = (finger_positions(gripper, width + sign * TINY) for sign in (1, -1))
        return [rate * (after - before) / (2 * TINY) for after, before in zip(*ends, strict=True)]
    driven = rate / 2
    if gripper.linkage is not None:
        bars = gripper.linkage
        driven = -rate / (2 * bars.length * math.cos(bars.open_angle - driven_position(gripper, width)))
    if (jaw := gripper.jaw) is not None:
        turned = jaw.opens * (driven_position(gripper, width) - jaw.closed)
        driven = jaw.opens * rate / (jaw.radius * max(math.cos(jaw.angle + turned), 1e-3))
    return [factor * driven for factor, _ in finger_couplings(gripper)]


def closing_frame(gripper: GripperConfig) -> NDArray[np.float64]:
    """Return the (4, 4) pose, in the TCP frame, of a frame whose y axis is the closing direction of the gripper."""
    T_tcp_closing = np.eye(4)
    if gripper.closing_axis == "x":
        T_tcp_closing[:2, :2] = [[0.0, 1.0], [-1.0, 0.0]]
    return T_tcp_closing


def finger_couplings(gripper: GripperConfig) -> list[tuple[float, float]]:
    """Return factor and offset of each joint relative to the driven joint, which is the first."""
    if gripper.travel:
        (_, start, *starts), (_, end, *ends) = gripper.travel[0], gripper.travel[-1]
        factors = [(after - before) / (end - start) for before, after in zip(starts, ends, strict=True)]
        return [(1.0, 0.0), *((factor, at - factor * start) for factor, at in zip(factors, starts, strict=True))]
    return [(factor, 0.0) for factor in gripper.mimic or [1.0] * len(gripper.joints)]
