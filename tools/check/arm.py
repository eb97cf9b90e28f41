"""Reach and collisions of the arm among the fixed parts of a cell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from common.config import RobotConfig, Surroundings
from common.errors import ConfigError
from common.messages import PlanningScene
from common.messages.basics import Header
from common.planning.collision import CollisionWorld
from common.planning.ik import controls_full_pose, explain_region_unreachable, pose_region, solve_ik, solve_region_ik
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.scene.fixtures import container_panels, fixture_objects
from tools.check import Finding, error, warning

Array = NDArray[np.float64]

RESTARTS = 5  # further IK seeds besides the home pose
SEEDS = 4


class Arm:
    """Robot and surroundings as the planner knows them before any detection."""

    def __init__(self, config: RobotConfig, around: Surroundings, geometry: RobotGeometry | None = None) -> None:
        """Load the robot.

        Args:
            config: the robot file.
            around: fixtures and containers.
            geometry: of the robot, if already loaded.

        Raises:
            ConfigError: the robot file does not fit its description.
        """
        self.robot = geometry.robot if geometry is not None else RobotModel.load(config)
        self.home: Array = self.robot.named("home")
        self._cache = ObstacleCache(geometry or RobotGeometry(self.robot))
        objects = fixture_objects(around)
        for container in around.containers.values():
            objects += container_panels(container, around.table_height)
        self._scene = PlanningScene(header=Header(frame_id="world"), objects=objects)

    def touching(self, q: Array, width: float | None = None) -> tuple[str, str] | None:
        """Return the colliding pair at joint positions (dof,) [rad] and a gripper width [m]; None if free."""
        # Contacts at the start are allowed for attached and perceived objects only, and there are none here.
        return CollisionWorld(self.robot, self._scene, start=q, cache=self._cache, width=width).colliding_pair(q)

    def check_poses(self) -> Iterator[Finding]:
        """Yield named poses in which the arm collides."""
        for name in self.robot.config.named_poses:
            q = self.robot.named(name)
            if pair := self.touching(q):
                what = f"robot.named_poses.{name}: {[round(float(value), 4) for value in q]} is in collision, "
                what += f"{pair[0]} with {pair[1]}"
                remedy = "correct the pose, or move the fixture, the container or robot.base_position"
                yield error(what, remedy, refused=True) if name == "home" else warning(what, remedy)

    def why_not(self, poses: Sequence[Array], width: float | None = None, tilt: float = 0.0) -> str:
        """Return why the tool reaches none of some poses without collision; empty if it reaches one.

        Args:
            poses: (4, 4) alternatives in world.
            width: of the gripper [m].
            tilt: tolerance for an arm with fewer than six joints [rad]; its yaw is free.
        """
        collision = ""
        for T in poses:
            for seed in range(SEEDS):
                rng = np.random.default_rng(seed)
                start = self.home if seed == 0 else rng.uniform(self.robot.lower, self.robot.upper)
                if controls_full_pose(self.robot):
                    q = solve_ik(self.robot, T, start, rng=rng, restarts=RESTARTS)
                else:
                    q = solve_region_ik(self.robot, pose_region(self.robot, T, tilt), start, rng=rng, restarts=RESTARTS)
                if q is None:
                    continue
                pair = self.touching(q, width)
                if pair is None:
                    return ""
                collision = collision or f"{pair[0]} would touch {pair[1]}"
        return collision or explain_region_unreachable(self.robot, pose_region(self.robot, poses[0], tilt), self.home)


def require_free_home(config: RobotConfig, around: Surroundings, geometry: RobotGeometry) -> None:
    """Return if the home pose is free of collisions.

    Raises:
        ConfigError: it is not; names the colliding pair.
    """
    for found in Arm(config, around, geometry).check_poses():
        if found.refused:
            field, _, rest = found.line.partition(": ")
            raise ConfigError(field, ..., rest)
