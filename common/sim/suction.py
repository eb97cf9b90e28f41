"""The seal of a suction cup on an object, the same in the kinematic world and in physics."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common.config import SuctionCup
from common.sim.objects import Solid

Array = NDArray[np.float64]

LIP_POINTS = 8  # on the ring of a cup
NEAR = 0.02  # [m] along the cup's axis; farther surfaces are no candidates
NOTHING = "nothing is at the cup"
GRAVITY = 9.81  # [m/s^2]


def seal_problem(cup: SuctionCup, solid: Solid, T_tcp_object: Array) -> str:
    """Return why a cup does not seal on a solid at a pose (4, 4) in the tool frame; empty if it does.

    The complete lip, center and ring, must meet the surface, within the give of the lip.
    """
    give = cup.give
    if float(np.linalg.norm(T_tcp_object[:3, 3])) > solid.reach + cup.lip_radius + NEAR:
        return NOTHING
    near = _distances(cup, solid, T_tcp_object)
    if not abs(near[0]) <= NEAR:
        return NOTHING
    if not np.isfinite(near).all():
        return f"the surface is smaller than the lip, {2e3 * cup.lip_radius:.3g} mm, or the cup is at its edge"
    if (uneven := float(np.ptp(near))) > 2 * give:
        return f"the surface is not flat: {1e3 * uneven:.1f} mm under the lip, which gives {2e3 * give:.3g} mm"
    if (off := float(near[np.abs(near).argmax()])) > give:
        return f"the lip is up to {1e3 * off:.1f} mm above the surface, and gives {1e3 * give:.3g} mm"
    return f"the lip is {-1e3 * off:.1f} mm below the surface" if off < -give else ""


def weight_problem(cup: SuctionCup, mass: float) -> str:
    """Return that a mass [kg] is too heavy for a cup at rest; empty if it is not, or if it is 0, unknown."""
    weight = mass * GRAVITY
    return "" if weight <= cup.force else f"it weighs {weight:.1f} N, and the cup holds {cup.force:.1f} N"


def lip(cup: SuctionCup) -> Array:
    """Center of a lip and points on its ring (1 + LIP_POINTS, 2) [m]."""
    around = np.linspace(0.0, 2 * math.pi, LIP_POINTS, endpoint=False)
    return np.vstack([(0.0, 0.0), cup.lip_radius * np.column_stack([np.cos(around), np.sin(around)])])


def _distances(cup: SuctionCup, solid: Solid, T_tcp_object: Array) -> Array:
    """Distance of the surface along the tool's z axis at each point of the lip [m]; infinite where it is missed."""
    points = lip(cup)
    if solid.shape == "sphere":
        x, y, z = T_tcp_object[:3, 3]
        inside = solid.radius**2 - ((points - (x, y)) ** 2).sum(axis=1)
        return np.where(inside > 0, z - np.sqrt(np.maximum(inside, 0.0)), np.inf)
    # Along the tool's z axis, which is the y axis of lines through (x, -y).
    T_along_tcp = np.eye(4)
    T_along_tcp[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    spans = solid.spans(T_along_tcp @ T_tcp_object, points * (1.0, -1.0))[: len(points)]
    return np.array([span[:, 0].min() if len(span) else np.inf for span in spans])
