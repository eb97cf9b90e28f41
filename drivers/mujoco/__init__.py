"""World with physics by MuJoCo (extra `physics`): gravity, friction, contact, and a servo-driven arm.

Imported only for `world.simulator: mujoco`.
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

ROLLING = 0.001  # [m] coefficient of rolling friction; without it round objects never stop


def create(
    world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances, gripper: GripperConfig | None
) -> PhysicsWorld:
    """Create the world with objects that all have a position; `hardware` adds the arm.

    Raises:
        ConfigError: MuJoCo is not installed, or an object cannot lie at its position.
    """
    require()
    from drivers.mujoco.world import PhysicsWorld

    return PhysicsWorld(world, objects, tolerances, gripper)


def renderer(
    around: Surroundings, scenery: Scenery, robots: Callable[[], Sequence[RobotModel]], *, plain: bool, camera: Pinhole,
    arm: bool = False,
) -> Renderer:
    """Create the renderer of this world for one camera, always with the arms. A plain image has no depth."""
    require()
    from drivers.mujoco.gl import select_gl
    from drivers.mujoco.rendering import PhysicsRenderer

    return PhysicsRenderer(around, scenery, robots(), camera, depth=not plain, gl=select_gl())


def require() -> None:
    """Raise ConfigError when MuJoCo is not installed."""
    if find_spec("mujoco") is None:
        raise ConfigError("world.simulator", "mujoco", "needs the extra `physics`: pip install 'zencell[physics]'")
