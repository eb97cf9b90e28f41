"""Whether a trajectory from elsewhere is free of collisions, before it moves the arm.

The cell's planners check what they plan, and its scene monitor checks the running motion against changes of the scene.
Nothing else checks a motion planned elsewhere before it starts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from common.config import RobotConfig
from common.control.trajectory import Tolerances, Trajectory, from_message, with_best_interpolation
from common.errors import Refused
from common.hardware.interface import Limits, Vector
from common.messages import JointTrajectory, PlanningScene
from common.planning.collision import CollisionWorld
from common.planning.contact_rules import PERCEIVED
from common.planning.obstacles import InvalidShape, ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel

STEP = 0.005  # [rad] between checked states
MAX_STATES = 100_000


class SceneCheck:
    """Checks trajectories against planning scenes and the arm against itself; not for two threads at a time."""

    def __init__(self, config: RobotConfig) -> None:
        """Load the robot, which takes a second."""
        self.robot = RobotModel.load(config)
        self._cache = ObstacleCache(RobotGeometry(self.robot))
        robot = self.robot
        self._limits = Limits(
            tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration)
        self._fingers = config.gripper.links if config.gripper else []

    def as_followed(self, trajectory: JointTrajectory) -> Trajectory:
        """Return a trajectory as the executor follows it, with the joints in the order of the robot."""
        points = from_message(trajectory, self._limits.names)
        return with_best_interpolation(points, self._limits, 1 + Tolerances().slack)

    def require_free(self, trajectory: JointTrajectory, scene: PlanningScene, measured: ArrayLike) -> None:
        """Return if nothing collides along the trajectory.

        The fingers may touch perceived objects, which is what a trajectory to a grasp does. What cameras see and the
        scene does not have is not checked.

        Args:
            trajectory: of all joints of the robot, with increasing times.
            scene: the newest.
            measured: joint positions now (dof,) [rad]: contact that there is now may end.

        Raises:
            Refused: a collision, with the pair and the time; or the check is impossible.
        """
        points = from_message(trajectory, self._limits.names)
        # The executor joins the points by cubics, or by quintics if the accelerations fit: check both.
        times, states = zip(*(_samples(replace(points, quintic=quintic)) for quintic in (False, True)), strict=True)
        touchable = [item.id for item in scene.objects if item.role in PERCEIVED]
        try:
            world = CollisionWorld(
                self.robot, scene, start=measured, cache=self._cache,
                allowed=[(link, name) for link in self._fingers for name in touchable])
        except InvalidShape as error:
            raise Refused("scene", str(error)) from None
        for at, path in zip(times, states, strict=True):
            if (hit := world.first_collision(path)) is not None:
                raise Refused("collision", f"{hit.pair[0]} collides with {hit.pair[1]} at {at[hit.index]:.2f} s")


def _samples(trajectory: Trajectory) -> tuple[Vector, Vector]:
    """Return times (N,) [s] and positions (N, dof) [rad] along a trajectory, about one step apart.

    Raises:
        Refused: there would be too many.
    """
    spans = np.diff(trajectory.times)
    speed = np.max([np.abs(trajectory.between(share)[1]) for share in np.linspace(0, 1, 9)], axis=(0, 2))
    counts = np.maximum(1, np.ceil(speed * spans / STEP))
    if not counts.sum() <= MAX_STATES:  # false also for NaN
        raise Refused("too_long", f"the check for collisions takes more than {MAX_STATES} states")
    times = [begin + np.arange(count) * span / count
             for begin, span, count in zip(trajectory.times, spans, counts, strict=False)]
    at = np.concatenate([*times, trajectory.times[-1:]])
    return at, trajectory.positions_at(at)
