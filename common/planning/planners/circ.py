"""A circular arc of the tool through a point or about a centre, with a trapezoidal profile of its speed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.planners import cartesian, lin
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, Problem, Result, ToolPath, check_step_count
from common.planning.waypoint_timing import ToolWaypoints, time_tool_path

Array = NDArray[np.float64]

_TOLERANCE = 0.001  # [m] that the tool may leave the arc between two IK solutions
_SAME = 1e-4  # [m] points closer than this do not define a circle
_STRAIGHT = 1e-3  # sine of an angle below which three points lie on a line
_OFF_CENTRE = 1e-3  # [m] by which start and goal may differ in their distance from the centre


class Options(lin.Options):
    """Limits of the tool, and how finely the arc is followed."""


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return a trajectory along the complete arc, or what ends it."""
    if not isinstance(problem.goal, Arc):
        return Result(error=NOT_APPLICABLE, message="a circular arc needs an arc goal")
    found = arc_waypoints(problem, problem.goal, options, cancel)
    if isinstance(found, Result):
        return found
    return Result(trajectory=time_tool_path(problem, found, options), fraction=1.0)


def arc_waypoints(problem: Problem, arc: Arc, options: Options, cancel: Cancel) -> ToolWaypoints | Result:
    """Return evenly spaced waypoints of the arc, or what ends it."""
    T_start, T_goal = problem.robot.fk(problem.start), arc.T_world_tcp
    start, goal = T_start[:3, 3], T_goal[:3, 3]
    try:
        if arc.via is not None:
            circle = circle_through(start, arc.via, goal)
        else:
            assert arc.center is not None  # the message has one of them
            circle = circle_about(start, arc.center, goal)
    except NoArc as error:
        return Result(error="bad_goal", message=f"no arc: {error}")
    if refusal := check_step_count(circle.length / options.step):
        return refusal
    poses = arc_poses(circle, T_start, T_goal, options.step, options.rotation_step)
    following = cartesian.Options(
        step=0.2,  # the poses are close enough together already
        rotation_step=1.0,
        jump_threshold=options.jump_threshold,
        path_tolerance=_TOLERANCE,
        min_fraction=1.0,
    )
    result = cartesian.plan(replace(problem, goal=ToolPath(poses)), following, cancel)
    if result.waypoints is None:
        return result
    turn = lin.line_travel(T_start, T_goal)[1]
    travel = np.linspace(0, 1, len(poses))[:, None] * np.array([circle.length, turn])
    return ToolWaypoints(result.waypoints, travel)


class NoArc(Exception):
    """Points through which there is no circle, or more than one."""


@dataclass(frozen=True)
class Circle:
    """centre + radius (cos(a) x + sin(a) y) for angles a from 0 at the start to `angle` [rad] at the goal.

    The radius changes evenly to `end_radius`, so that a goal slightly off the circle is still reached.
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
        """Return (N, 3) [m] at shares (N,) of the arc."""
        angles = self.angle * shares[:, None]
        radii = self.radius + shares[:, None] * (self.end_radius - self.radius)
        return np.asarray(self.centre + radii * (np.cos(angles) * self.x + np.sin(angles) * self.y))


def circle_through(start: Array, via: Array, goal: Array) -> Circle:
    """Return the arc from start to goal (3,) [m] that passes `via`.

    The centre is where the perpendicular bisectors of the two chords meet in the plane of the points.

    Raises:
        NoArc: the points coincide or lie on a line.
    """
    to_via, to_goal = via - start, goal - start
    a, b = float(np.linalg.norm(to_via)), float(np.linalg.norm(to_goal))
    if min(a, b, math.dist(via, goal)) < _SAME:
        raise NoArc("start, via point and goal must be three different points")
    normal = np.cross(to_via, to_goal)
    area = float(np.linalg.norm(normal))
    if area < _STRAIGHT * a * b:
        raise NoArc("start, via point and goal lie on a straight line")
    offset = (a**2 * np.cross(to_goal, normal) - b**2 * np.cross(to_via, normal)) / (2 * area**2)
    return _arc(start + offset, start, goal, normal / area)


def circle_about(start: Array, centre: Array, goal: Array) -> Circle:
    """Return the shorter arc from start to goal (3,) [m] about a centre.

    Raises:
        NoArc: the centre is not equally far from both, or on the line between them, where both arcs are equally long.
    """
    one, other = start - centre, goal - centre
    a, b = float(np.linalg.norm(one)), float(np.linalg.norm(other))
    if abs(a - b) > _OFF_CENTRE:
        raise NoArc(f"the centre is {a:.4f} m from the start and {b:.4f} m from the goal")
    normal = np.cross(one, other)
    area = float(np.linalg.norm(normal))
    if min(a, b, math.dist(start, goal)) < _SAME or area < _STRAIGHT * a * b:
        raise NoArc("start, centre and goal lie on a straight line, so the plane of the circle is undefined")
    return _arc(centre, start, goal, normal / area)


def _arc(centre: Array, start: Array, goal: Array, normal: Array) -> Circle:
    """Return the arc from start to goal, anticlockwise about the normal."""
    x = start - centre
    radius = float(np.linalg.norm(x))
    x = x / radius
    y = np.cross(normal, x)
    to_goal = goal - centre
    angle = math.atan2(float(to_goal @ y), float(to_goal @ x)) % (2 * math.pi)
    return Circle(centre, x, y, radius, float(np.linalg.norm(to_goal)), angle)


def arc_poses(circle: Circle, T_start: Array, T_goal: Array, step: float, rotation_step: float) -> Array:
    """Return (N, 4, 4) evenly spaced poses along an arc, with the orientation interpolated by the shortest turn.

    Args:
        circle: from the start's position to the goal's.
        T_start, T_goal: (4, 4) poses at its ends.
        step, rotation_step: largest distance [m] and turn [rad] between two poses.
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
