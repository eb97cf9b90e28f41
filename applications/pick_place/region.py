"""The part of the table on which balls may lie and a camera can see them, and how much of it is hidden now."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from applications.pick_place.resting import Resting, is_table
from common.config import Surroundings
from common.perception.occlusion import Occlusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds, outside_reason

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

MOST_HIDDEN = 0.02  # part of the table within reach that may be hidden while it counts as seen
STEP = 0.02  # [m] between the places that stand for the table


class Region:
    """Places (n, 3) [m] in world at which a ball may lie within reach, and which of them a camera can see at all."""

    def __init__(self, around: Surroundings, bounds: WorkspaceBounds) -> None:
        """Spread places over the tables, within the bounds and clear of the containers."""
        self.radius = around.ball_radius
        self._resting = [Resting(around.ball_radius, around.table_height, box) for box in around.containers.values()]
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
            if not outside_reason(bounds, place)
            and not any(max(abs(place[0] - box.x), abs(place[1] - box.y)) < box.half_side + self.radius
                        for box in around.containers.values())
        ]).reshape(-1, 3)
        self._seen_by: dict[int, tuple[Pinhole, Bools]] = {}

    def within(self, camera: Pinhole, silhouettes: RobotSilhouettes, robot: RobotModel) -> Bools:
        """(n,) the places that a camera sees while neither container nor the robot's foot is before them."""
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
        """The share of what any of several views can see that none of them shows now.

        Args:
            views: of each what it can see at all, and what is hidden in it now.
        """
        all_of_it = np.zeros(len(self.places), bool)
        shown = np.zeros(len(self.places), bool)
        for within, hidden in views:
            all_of_it |= within
            shown |= within if hidden is None else within & ~hidden.occludes(self.places, self.radius)
        return float(np.mean(~shown[all_of_it])) if all_of_it.any() else 0.0


def looking_poses(
    robot: RobotModel, cameras: Sequence[Pinhole], region: Region, most: float, carries: float
) -> list[list[float]]:
    """Joint positions [rad] from which cameras see the table past the robot: home turned about the first joint.

    The least turn first, of those that hide as little as may be; else the one that hides least.
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
