"""What a person sees who moves a simulated arm by hand: whether there is anything in its way."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from common.config import Cell
from common.messages import JointState, PlanningScene
from common.planning.collision import CollisionWorld
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel


class Sight:
    """Looks where an arm would go that is jogged.

    A jogged arm goes where it is told, and a simulated one goes through what a real one would run into: nobody could
    bring it away from there, because from inside a solid there is no plan.
    """

    def __init__(self, cell: Cell) -> None:
        """Know the arm."""
        self._robot = RobotModel.load(cell.robot)
        self._cache = ObstacleCache(RobotGeometry(self._robot))
        self._gripper = cell.robot.gripper.links if cell.robot.gripper else []
        self._padding = cell.motion.object_padding

    def clear(self, state: JointState, scene: PlanningScene, asked: Mapping[str, float], seconds: float) -> bool:
        """Whether the arm touches nothing that a retreat would not free it from, if it went on for so long.

        Args:
            state: of the arm when it was seen last.
            scene: what stands around.
            asked: velocities of joints [rad/s]; the others go on until they rest.
            seconds: of cell time.
        """
        robot, names = self._robot, self._robot.joint_names
        q, dq = dict(zip(state.name, state.position, strict=True)), dict(zip(state.name, state.velocity, strict=False))
        if not all(name in q for name in names):
            return False
        start = np.array([q[name] for name in names])
        ahead = start + seconds * np.array([asked.get(name, dq.get(name, 0.0)) for name in names])
        fingers = [(link, thing.id) for link in self._gripper for thing in scene.objects if thing.role == "target"]
        world = CollisionWorld(robot, scene, start=start, padding=self._padding, allowed=fingers, cache=self._cache)
        return not world.collides(start) and world.edge_free(start, np.clip(ahead, robot.lower, robot.upper))
