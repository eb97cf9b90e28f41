"""A world with physics, by MuJoCo (extra `physics`): gravity, friction, contact, an arm that is driven by servos.

Only what `world.simulator: mujoco` names imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

from common.config import GripperConfig, ObjectConfig, Scenery, Surroundings, World
from common.errors import ConfigError
from common.sim.interface import GraspTolerances

if TYPE_CHECKING:
    from common.perception.pinhole import Pinhole
    from common.robot.model import RobotModel
    from common.sim.interface import Renderer
    from drivers.mujoco.world import PhysicsWorld


def create(
    world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances, gripper: GripperConfig | None
) -> PhysicsWorld:
    """The world with its objects, each of which has a place; `hardware` puts the arm into it.

    Raises:
        ConfigError: MuJoCo is not installed, an object cannot lie where it is to, or the gripper is a suction cup.
    """
    require()
    from drivers.mujoco.world import PhysicsWorld

    return PhysicsWorld(world, objects, tolerances, gripper)


def renderer(
    around: Surroundings, scenery: Scenery, robot: Callable[[], RobotModel], *, plain: bool, camera: Pinhole,
    arm: bool = False,
) -> Renderer:
    """What draws this world for a camera, always with the arm. A plain picture has no depth."""
    require()
    from drivers.mujoco.gl import select_gl
    from drivers.mujoco.rendering import PhysicsRenderer

    return PhysicsRenderer(around, scenery, robot(), camera, depth=not plain, gl=select_gl())


def require() -> None:
    """Raise ConfigError when MuJoCo is not installed."""
    if find_spec("mujoco") is None:
        raise ConfigError("world.simulator", "mujoco", "needs the extra `physics`: pip install 'zencell[physics]'")
