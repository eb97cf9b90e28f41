"""The motions of outlining one object, as goals for the tool centre point, and what the task knows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field

from applications.outlining.messages import OutlinePoints
from common import messages as m
from common.config import GripperConfig, Number, Parameters, Tunable
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.tasks.stages import Cycle, Move, Place, View, place_of

NEAR = 0.01  # [m] an object that was perceived is this exact


@dataclass
class OutlineView(View):
    """What the task knows, and the path along the contour that was chosen."""

    path: OutlinePoints | None = None

    @property
    def stamps(self) -> tuple[float, ...]:
        """When the picture was taken in which the contour was found [s]."""
        return (self.path.header.stamp * 1e-9 if self.path else 0.0,)

    def solid(self) -> str | None:
        """Id of the perceived object that the path goes round; None while the planning scene does not have it.

        A path that was given need not go round anything: then the id of what it comes near, or an empty string.
        """
        if self.path is None or self.scene is None or self.scene.header.stamp < self.path.header.stamp:
            return None
        places = [place_of(pose) for pose in self.path.poses]
        beside = {o.id: sum(_beside(o, at) for at in places) for o in self.scene.objects if o.role == "target"}
        if self.path.given:
            return max((name for name, count in beside.items() if count), key=beside.__getitem__, default="")
        around = [o for o in self.scene.objects if beside.get(o.id) == len(places)]
        return min(around, key=_area).id if around else None


def _beside(thing: m.CollisionObject, place: Place) -> bool:
    """Whether a place lies within the box about an upright prism."""
    at = thing.pose.position
    xs, ys = zip(*thing.outline, strict=True) if thing.outline else ((0.0,), (0.0,))
    x, y, z = place
    return (min(xs) - NEAR <= x - at.x <= max(xs) + NEAR and min(ys) - NEAR <= y - at.y <= max(ys) + NEAR
            and abs(z - at.z) <= thing.dimensions[-1] / 2 + NEAR)


def _area(thing: m.CollisionObject) -> float:
    xs, ys = zip(*thing.outline, strict=True) if thing.outline else ((0.0,), (0.0,))
    return float((max(xs) - min(xs)) * (max(ys) - min(ys)))


def closed(path: OutlinePoints) -> list[Place]:
    """The points of a path [m] and the first once more."""
    points = [place_of(pose) for pose in path.poses]
    return [*points, points[0]]


def same_place(path: OutlinePoints, other: OutlinePoints | None) -> bool:
    """Whether the boxes about two paths are the same, as exactly as is perceived."""
    if other is None or not path.poses or not other.poses:
        return False
    a, b = (np.array([place_of(pose) for pose in each.poses]) for each in (path, other))
    return bool(np.abs([a.min(axis=0) - b.min(axis=0), a.max(axis=0) - b.max(axis=0)]).max() <= NEAR)


def length(points: list[Place]) -> float:
    """Length [m] of the lines through points."""
    return sum(math.dist(a, b) for a, b in pairwise(points))


class TracingParameters(Parameters):
    """How the tool goes along a contour."""

    standoff: Tunable[float] = Field(
        0.002, ge=0, le=0.2, description="of the finger tips above the contour, which they must not drag [m]"
    )
    approach_clearance: Tunable[float] = Field(
        0.10, gt=0, le=0.5, description="approach and retreat above the contour [m]"
    )
    tool_rpy: Tunable[tuple[Number, Number, Number]] = Field(
        (0.0, -math.pi, -math.pi), description="of the tool in world while tracing [rad], R = Rz Ry Rx"
    )
    tool_speed: Tunable[float] = Field(
        0.05, gt=0, le=1, description="along the contour, where limits and corners allow [m/s]"
    )
    step: Tunable[float] = Field(0.001, ge=1e-4, le=0.05, description="along the contour between IK solutions [m]")
    min_fraction: Tunable[float] = Field(0.99, gt=0, le=1, description="of the contour that must be possible")


@dataclass(frozen=True)
class Legs:
    """Builds the motions; knows heights and speed, nothing of what happens."""

    p: TracingParameters
    gripper: GripperConfig

    def outline(self, points: list[Place], solid: str, cycle: Cycle) -> list[Move]:
        """Above the first point, down, along all points, up, home."""
        x, y, z = points[0]
        touches = [(link, solid) for link in self.gripper.links] if solid else []
        trace = m.PathGoal(waypoints=[self._pose(p) for p in points], step=self.p.step,
                           min_fraction=self.p.min_fraction, tool_speed=self.p.tool_speed)
        above = m.PoseGoal(pose=self._pose((x, y, z + self.p.approach_clearance)))
        down = m.PoseGoal(pose=self._pose(points[0]))
        return [
            Move("approach", "APPROACHING", cycle, goal=above, fresh=True, whole=True),
            Move("descend", "APPROACHING", cycle, goal=down, straight=True, touches=touches),
            Move("trace", "TRACING", cycle, goal=trace, touches=touches),
            Move("retreat", "RETREATING", cycle, goal=above, straight=True, touches=touches),
            self.home(cycle),
        ]

    def home(self, cycle: Cycle) -> Move:
        """To the pose from which the camera sees everything."""
        return Move("home", "HOMING", cycle, goal=m.JointGoal(named="home"))

    def _pose(self, at: Place) -> m.Pose:
        x, y, z = at
        return matrix_to_pose(transform(rpy_to_matrix(*self.p.tool_rpy), (x, y, z + self.p.standoff)))
