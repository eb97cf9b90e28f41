"""Where the arm goes to be out of the camera's way: not before there is something that it hides."""

from __future__ import annotations

from applications.pick_place.parameters import Config
from applications.pick_place.region import MOST_HIDDEN, Region, looking_poses
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.scene.workspace import WorkspaceBounds

MOST = 4  # poses that are tried one after the other


class Looking:
    """Joint positions [rad] from which the cameras see past the arm, the nearest to home first."""

    def __init__(self, config: Config) -> None:
        """Begin without any: they take some hundredths of a second to find."""
        self._config = config
        self._poses: list[list[float]] | None = None
        self._tried = 0

    def next(self) -> list[float]:
        """The next one to try; empty when all were tried and something was hidden still."""
        poses = self._all()
        self._tried += 1
        return poses[self._tried - 1] if self._tried <= len(poses) else []

    def best(self) -> list[float]:
        """The first of them; empty without any."""
        return next(iter(self._all()), [])

    def found(self) -> None:
        """Everything was seen, or is to be tried anew: the next time it begins with the first again."""
        self._tried = 0

    def _all(self) -> list[list[float]]:
        p = self._config
        if p.look_from:
            return [list(p.look_from)]
        if self._poses is None:
            cameras = [Pinhole.from_config(camera) for camera in p.world.cameras.values() if not camera.mount]
            region = Region(p.world, WorkspaceBounds())
            radius = p.world.ball_radius
            self._poses = looking_poses(RobotModel.load(p.robot), cameras, region, MOST_HIDDEN, radius)[:MOST]
        return self._poses
