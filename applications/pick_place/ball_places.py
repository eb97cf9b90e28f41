"""Where balls can lie, and which part of the table the cameras see."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from applications.pick_place.grasping import Config
from common.config import Container, Fixture, Surroundings
from common.perception.occlusion import Occlusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds, out_of_bounds_reason

Array = npt.NDArray[np.float64]


def is_table(fixture: Fixture, height: float) -> bool:
    """Return whether the top of a fixture is a table at a height [m]."""
    top = fixture.position[2] + fixture.dimensions[2] / 2 if fixture.shape == "box" else None
    return top is not None and abs(top - height) < 1e-3


def shows_table(around: Surroundings, camera: Pinhole, pixels: Array) -> npt.NDArray[np.bool_]:
    """Return for pixels (..., 2) whether they would show a table with nothing in front of it (...)."""
    places = camera.on_plane(pixels, around.table_height)
    shown = np.zeros(places.shape[:-1], bool)
    for fixture in around.fixtures:
        if is_table(fixture, around.table_height):
            offset = np.abs(places - fixture.position[:2])  # NaN above the horizon: no table there
            shown |= (offset <= np.array(fixture.dimensions[:2]) / 2).all(axis=-1)
    return shown


@dataclass(frozen=True)
class BallGeometry:
    """Radius of the balls and the heights at which their centers can be, in world [m]."""

    radius: float
    table_height: float
    container: Container

    @classmethod
    def of(cls, surroundings: Surroundings) -> BallGeometry:
        """Take the geometry from the surroundings."""
        return cls(surroundings.ball_radius, surroundings.table_height, surroundings.container)

    @property
    def plane(self) -> float:
        """Height of the center of a ball on the table [m]."""
        return self.table_height + self.radius

    @property
    def layers(self) -> list[float]:
        """Heights of the ball centers in each layer of the container, lowest first [m]."""
        lowest = self.table_height + self.container.floor_thickness + self.radius
        return [lowest + 2 * self.radius * layer for layer in range(self.container.layers)]

    @property
    def stack_height(self) -> float:
        """Height of the top of a full container: of its uppermost ball, or of its walls if they are higher [m]."""
        stack = self.container.floor_thickness + 2 * self.radius * self.container.layers
        return self.table_height + max(stack, self.container.wall_height)

    def meets_container(self, origin: npt.ArrayLike, direction: npt.ArrayLike) -> bool:
        """Return whether a ray meets the container's volume up to the stack height, by the slab method.

        The ray is inside between the last entry into and the first exit from the three pairs of planes.

        Args:
            origin: (3,) in world [m].
            direction: (3,) in world, of any length.
        """
        o, d = np.asarray(origin, dtype=float).tolist(), np.asarray(direction, dtype=float).tolist()
        entry, leave = 0.0, math.inf
        for at, along, (low, high) in zip(o, d, self._slabs, strict=True):  # scalars are much faster than arrays here
            if abs(along) < 1e-12:
                if not low <= at <= high:
                    return False
                continue
            first, second = (low - at) / along, (high - at) / along
            entry, leave = max(entry, min(first, second)), min(leave, max(first, second))
        return entry <= leave

    def shows_container(self, camera: Pinhole, pixel: Sequence[float] | Array) -> bool:
        """Return whether the ray through a pixel (u, v) meets the container's volume up to the stack height."""
        return self.meets_container(*camera.ray(pixel))

    @cached_property
    def _slabs(self) -> tuple[tuple[float, float], ...]:
        """Extent of the container's volume along each axis [m]."""
        c, h = self.container, self.container.half_side
        return (c.x - h, c.x + h), (c.y - h, c.y + h), (self.table_height, self.stack_height)

    def heights(self, camera: Pinhole, pixel: Sequence[float] | Array) -> list[float]:
        """Return the heights [m] that the center of a ball seen at a pixel can have."""
        if not self.shows_container(camera, pixel):
            return [self.plane]
        # Heights that differ by a few millimeters cannot be distinguished by the apparent size of a ball.
        apart = all(abs(z - self.plane) > self.radius / 3 for z in self.layers)
        return [self.plane, *self.layers] if apart else self.layers

    def can_lie(self, center: npt.ArrayLike) -> bool:
        """Return whether a ball can lie with its center at (x, y, z) [m] in world: higher ones only between walls."""
        x, y, z = np.asarray(center, dtype=float)
        if z < self.plane + self.radius:
            return True
        room = self.container.half_side - self.container.wall_thickness - 0.7 * self.radius
        return bool(abs(x - self.container.x) <= room and abs(y - self.container.y) <= room)


Bools = npt.NDArray[np.bool_]

MOST_HIDDEN = 0.02  # fraction of the reachable table that may be occluded while it counts as seen
STEP = 0.02  # [m] grid of positions that represent the table


class VisibleTable:
    """Positions (n, 3) [m] in world where a ball may lie within reach, and which of them each camera can see."""

    def __init__(
        self, around: Surroundings, bounds: WorkspaceBounds, base: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Spread positions over the tables, outside of the containers and within the bounds about a base [m]."""
        self.radius = around.ball_radius
        self._resting = [BallGeometry(around.ball_radius, around.table_height, box)
                         for box in around.containers.values()]
        plane = around.table_height + around.ball_radius
        found = [
            (x, y, plane)
            for fixture in around.fixtures
            if is_table(fixture, around.table_height)
            for x in _steps(fixture.position[0], fixture.dimensions[0] / 2)
            for y in _steps(fixture.position[1], fixture.dimensions[1] / 2)
        ]
        self.places = np.array([
            place for place in dict.fromkeys(found)
            if not out_of_bounds_reason(bounds, place, base)
            and not any(max(abs(place[0] - box.x), abs(place[1] - box.y)) < box.half_side + self.radius
                        for box in around.containers.values())
        ]).reshape(-1, 3)
        self._seen_by: dict[int, tuple[Pinhole, Bools]] = {}

    def within(self, camera: Pinhole, silhouettes: RobotSilhouettes, robot: RobotModel) -> Bools:
        """(n,) positions that a camera sees past the container and the robot's base."""
        known = self._seen_by.get(id(camera))
        if known is not None and known[0] is camera:
            return known[1]
        if not len(self.places):
            return np.zeros(0, bool)
        pixels = camera.project(self.places)
        depth = np.maximum(camera.to_camera(self.places)[:, 2], 1e-3)
        margin = max(camera.fx, camera.fy) * self.radius / depth + 2
        seen = np.array([camera.in_image(pixel, float(away)) for pixel, away in zip(pixels, margin, strict=True)])
        behind = np.array([any(r.shows_container(camera, pixel) for r in self._resting) for pixel in pixels])
        foot = silhouettes.occlusion(camera, [robot.named("home")], [robot.config.base_link])
        found: Bools = seen & ~behind & ~foot.occludes(self.places, self.radius)
        self._seen_by[id(camera)] = camera, found
        return found

    def hidden(self, views: Iterable[tuple[Bools, Occlusion | None]]) -> float:
        """Return the fraction of the positions visible to any view that no view shows now.

        Args:
            views: of each view the positions it can see at all, and its current occlusion.
        """
        all_of_it = np.zeros(len(self.places), bool)
        shown = np.zeros(len(self.places), bool)
        for within, hidden in views:
            all_of_it |= within
            shown |= within if hidden is None else within & ~hidden.occludes(self.places, self.radius)
        return float(np.mean(~shown[all_of_it])) if all_of_it.any() else 0.0


def find_viewing_poses(
    robot: RobotModel, cameras: Sequence[Pinhole], region: VisibleTable, most: float, carries: float
) -> list[list[float]]:
    """Return joint positions [rad] in which cameras see the table past the arm: home rotated about the first joint.

    Smallest rotation first, of those below the occlusion limit; else the one with the smallest occlusion.
    """
    silhouettes, home = RobotSilhouettes(robot, carries), robot.named("home")
    within = [region.within(camera, silhouettes, robot) for camera in cameras]
    found: list[tuple[float, list[float]]] = []
    for turn in sorted(np.radians(np.arange(-165, 166, 15)).tolist(), key=lambda turn: (abs(turn), turn)):
        q = home.copy()
        q[0] += turn
        if robot.within_limits(q):
            share = region.hidden(
                (seen, silhouettes.occlusion(camera, [q])) for seen, camera in zip(within, cameras, strict=True))
            found.append((share, q.tolist()))
    good = [q for share, q in found if share <= most]
    return good or [min(found)[1]] if found else []


def _steps(middle: float, half: float) -> list[float]:
    count = max(1, round(2 * half / STEP))
    return [round(middle - half + (k + 0.5) * 2 * half / count, 6) for k in range(count)]


MOST = 4  # poses to try one after the other


class ViewingPoses:
    """Joint positions [rad] in which the cameras see past the arm, nearest to home first."""

    def __init__(self, config: Config) -> None:
        """Start without any; finding them takes some hundredths of a second."""
        self._config = config
        self._poses: list[list[float]] | None = None
        self._tried = 0

    def next(self) -> list[float]:
        """Return the next pose to try; empty when all were tried and something is still occluded."""
        poses = self._all()
        self._tried += 1
        return poses[self._tried - 1] if self._tried <= len(poses) else []

    def best(self) -> list[float]:
        """Return the first pose; empty without any."""
        return next(iter(self._all()), [])

    def found(self) -> None:
        """Start with the first pose the next time: everything is visible, or all poses may be tried again."""
        self._tried = 0

    def _all(self) -> list[list[float]]:
        p = self._config
        if p.look_from:
            return [list(p.look_from)]
        if self._poses is None:
            cameras = [Pinhole.from_config(camera) for camera in p.world.cameras.values() if not camera.mount]
            region = VisibleTable(p.world, WorkspaceBounds())
            radius = p.world.ball_radius
            self._poses = find_viewing_poses(RobotModel.load(p.robot), cameras, region, MOST_HIDDEN, radius)[:MOST]
        return self._poses
