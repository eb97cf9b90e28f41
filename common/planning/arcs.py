"""Circular arcs of the tool: through a point on the way, or about a centre."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAME = 1e-4  # [m] points closer than this do not tell a circle
_STRAIGHT = 1e-3  # sine of an angle below which three points lie on a line
_OFF_CENTRE = 1e-3  # [m] by which start and goal may differ in their distance from the centre


class NoArc(Exception):
    """Points through which there is no circle, or more than one."""


@dataclass(frozen=True)
class Circle:
    """centre + radius (cos(a) x + sin(a) y) for angles a from 0 at the start to `angle` [rad] at the goal.

    A goal that is a little farther off than the start, or less far, is met all the same: the radius changes evenly.
    """

    centre: Array
    x: Array
    y: Array
    radius: float
    end_radius: float
    angle: float

    @property
    def length(self) -> float:
        """Of the arc [m]."""
        return self.radius * self.angle

    def points(self, shares: Array) -> Array:
        """(N, 3) at shares (N,) of the way [m]."""
        angles = self.angle * shares[:, None]
        radii = self.radius + shares[:, None] * (self.end_radius - self.radius)
        return np.asarray(self.centre + radii * (np.cos(angles) * self.x + np.sin(angles) * self.y))


def circle_through(start: Array, via: Array, goal: Array) -> Circle:
    """The arc from start to goal (3,) [m] that passes `via`.

    The centre is where the perpendicular bisectors of the two chords meet in the plane of the points.

    Raises:
        NoArc: the points coincide or lie on a line.
    """
    to_via, to_goal = via - start, goal - start
    a, b = float(np.linalg.norm(to_via)), float(np.linalg.norm(to_goal))
    if min(a, b, math.dist(via, goal)) < _SAME:
        raise NoArc("start, point on the way and goal must be three different points")
    normal = np.cross(to_via, to_goal)
    area = float(np.linalg.norm(normal))
    if area < _STRAIGHT * a * b:
        raise NoArc("start, point on the way and goal lie on a straight line")
    offset = (a**2 * np.cross(to_goal, normal) - b**2 * np.cross(to_via, normal)) / (2 * area**2)
    return _arc(start + offset, start, goal, normal / area)


def circle_about(start: Array, centre: Array, goal: Array) -> Circle:
    """The shorter arc from start to goal (3,) [m] about a centre.

    Raises:
        NoArc: the centre is not as far from the one as from the other, or between them, where both arcs are as long.
    """
    one, other = start - centre, goal - centre
    a, b = float(np.linalg.norm(one)), float(np.linalg.norm(other))
    if abs(a - b) > _OFF_CENTRE:
        raise NoArc(f"the centre is {a:.4f} m from the start and {b:.4f} m from the goal")
    normal = np.cross(one, other)
    area = float(np.linalg.norm(normal))
    if min(a, b, math.dist(start, goal)) < _SAME or area < _STRAIGHT * a * b:
        raise NoArc("start, centre and goal lie on a straight line, so the plane of the circle is not known")
    return _arc(centre, start, goal, normal / area)


def _arc(centre: Array, start: Array, goal: Array, normal: Array) -> Circle:
    """Anticlockwise about the normal from start to goal."""
    x = start - centre
    radius = float(np.linalg.norm(x))
    x = x / radius
    y = np.cross(normal, x)
    to_goal = goal - centre
    angle = math.atan2(float(to_goal @ y), float(to_goal @ x)) % (2 * math.pi)
    return Circle(centre, x, y, radius, float(np.linalg.norm(to_goal)), angle)


def arc_poses(circle: Circle, T_start: Array, T_goal: Array, step: float, rotation_step: float) -> Array:
    """(N, 4, 4) evenly spaced poses along an arc, the orientation turning evenly by the shortest turn.

    Args:
        circle: from the start's position to the goal's.
        T_start, T_goal: (4, 4) poses at its ends.
        step, rotation_step: way [m] and turn [rad] between two poses at most.
    """
    turn = pin.log3(T_start[:3, :3].T @ T_goal[:3, :3])
    angle = float(np.linalg.norm(turn))
    count = max(2, math.ceil(circle.length / step - 1e-6), math.ceil(angle / rotation_step - 1e-6))
    shares = np.linspace(0, 1, count + 1)
    poses = np.tile(np.eye(4), (count + 1, 1, 1))
    poses[:, :3, 3] = circle.points(shares)
    poses[:, :3, :3] = [T_start[:3, :3] @ pin.exp3(share * turn) for share in shares]
    poses[0], poses[-1] = T_start, T_goal
    return poses
