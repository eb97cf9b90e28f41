"""The seam between the controller and whatever simulates the world about the arm: small, so that physics fits behind.

A simulator is a module (of this folder, or a dotted one of the user's own) that `world.simulator` names, with

    def create(world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances,
               gripper: GripperConfig | None) -> SimulatedWorld

where `objects` are those of the world, each with a place, and `tolerances` tell when the fingers catch something. What
it gives is a `FeltWorld`, or a `PhysicalWorld` that brings an arm of its own for robot files with the backend `mock`.
Times are cell time [s], passed in. What cameras see of it is drawn by what its module offers as

    def renderer(around: Surroundings, scenery: Scenery, robot: Callable[[], RobotModel], *, plain: bool,
                 camera: Pinhole, arm: bool) -> Renderer

in the process of each camera, from `scene_objects` and `joint_states`; a module without it is drawn as `kinematic` is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from common.config import GripperConfig, ObjectConfig, Parameters, Scenery, Surroundings, Tunable, World
from common.errors import ConfigError
from common.hardware.interface import Hardware, Limits
from common.messages import Header, JointState, SceneUpdate, WorldEdit, WorldObject, WorldObjects
from common.plugins import find_plugin

if TYPE_CHECKING:
    from common.perception.pinhole import Pinhole
    from common.robot.model import RobotModel
    from common.sim.ray_caster import View

Array = NDArray[np.float64]
Numbers = tuple[float, ...]

GROUP = "zencell.worlds"
KINEMATIC = "kinematic"  # the default; it draws for worlds that draw nothing themselves


class StandingObject(BaseModel):
    """An object as it is found after a restart; poses are x, y, z [m] and a quaternion x, y, z, w.

    `made` is what it is when a person added it; `like` names the object of the first layout whose shape it has.
    `details` are the simulator's own.
    """

    pose: Numbers
    made: WorldObject | None = None
    like: str = ""
    details: dict[str, Any] = {}


class SimulatedWorld(Protocol):
    """What is asked of a simulated world: the truth. `version` grows whenever something has changed."""

    version: int

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as a person asks; the id of what was changed, empty for a reset.

        Raises:
            Refused: says why, and what would do. Nothing has changed then.
        """

    @property
    def ids(self) -> list[str]:
        """What is in it."""

    def objects(self, header: Header) -> WorldObjects:
        """Where everything is."""

    def take_events(self) -> list[SceneUpdate]:
        """What was taken away or came to lie since the last call, in order."""

    @property
    def layout(self) -> dict[str, Numbers]:
        """Where everything was at first, (x, y, z) [m] by id."""

    def standing(self) -> dict[str, StandingObject]:
        """Everything as it is, for `restore`."""

    def restore(self, objects: Mapping[str, StandingObject]) -> None:
        """Put everything where it was."""


@runtime_checkable
class FeltWorld(SimulatedWorld, Protocol):
    """A world without forces: the hand, which others move, is asked for, and told what is in its way."""

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """The width [m] that the fingers cannot close below: what is between them now, or 0.

        Args:
            T_world_tcp: (4, 4) pose of the tool centre point.
            width: between the inner faces of the fingers, or the valve of a cup [m].
        """

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Move on to a time: grasp what the fingers press on, carry it, let it go, let it fall.

        Args:
            now: cell time [s].
            T_world_tcp: (4, 4) pose of the hand.
            width: between the fingers [m].
            gripping: whether the fingers press on something.
        """


@runtime_checkable
class PhysicalWorld(SimulatedWorld, Protocol):
    """A world with forces, which has an arm of its own: time passes in it when that is read."""

    def hardware(self, robot: RobotModel, limits: Limits, start: Array) -> Hardware:
        """The arm in this world, at rest at `start` (dof,) [rad]. Called once, before anything else but `layout`.

        Raises:
            ConfigError: the robot cannot be simulated.
        """


class GraspTolerances(Parameters):
    """Where a thing must be for the fingers to catch it, in the frame of the tool centre point."""

    across: Tunable[float] = Field(
        0.010, gt=0, le=0.05, description="half the width of a finger pad: off its middle, tool x axis [m]"
    )
    along: Tunable[float] = Field(
        0.010, gt=0, le=0.05, description="half the height of a finger pad: off its middle, tool z axis [m]"
    )
    sideways: Tunable[float] = Field(
        0.002, ge=0, le=0.05, description="a thing may overlap an open finger by this, tool y [m]"
    )
    release: Tunable[float] = Field(0.002, gt=0, le=0.02, description="let go when the fingers are this much wider [m]")


class Simulator(Protocol):
    """A module that simulates a world."""

    def create(
        self, world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances,
        gripper: GripperConfig | None, /,
    ) -> SimulatedWorld:
        """The world with its objects, each of which has a place."""


def load_world(
    world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances | None = None,
    gripper: GripperConfig | None = None,
) -> SimulatedWorld:
    """The simulated world that `world.simulator` names, with these objects, each of which has a place.

    Without a gripper fingers close along the tool's y axis.

    Raises:
        UnknownName: no such simulator; lists the choices.
        ConfigError: a module that cannot be imported or is no simulator, or an object that cannot be where it is.
    """
    module = _module(world.simulator)
    if not hasattr(module, "create"):
        raise ConfigError("world.simulator", world.simulator, "is no simulator: it has no create")
    return cast(Simulator, module).create(world, objects, tolerances or GraspTolerances(), gripper)


def require_simulator(name: str) -> None:
    """Return when there is a simulator of that name, with what it says by its own `require`, if any, that it needs.

    Raises:
        UnknownName: no such simulator; lists the choices.
        ConfigError: a module that cannot be imported, or something that is not installed.
    """
    if name != KINEMATIC:
        require = getattr(_module(name), "require", None)
        if require is not None:
            require()


class Renderer(Protocol):
    """Draws what one camera sees. Its calls may block and may come from any thread, one at a time."""

    camera: Pinhole
    needs_arm: bool
    """Whether the arm is in the picture, so that `render` wants the state of its joints."""

    @property
    def level(self) -> Array:
        """(3,) [lx] of blue, green and red light that the value 255 of a white surface stands for."""

    def move_camera(self, camera: Pinhole) -> None:
        """Take the camera elsewhere; its intrinsics stay."""

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery."""

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Whether to `render` the objects may take longer than a moment."""

    def render(self, objects: Sequence[WorldObject], joints: JointState | None = None) -> View:
        """The view of the objects, and of the arm in that state if it is complete; what is "elsewhere" is not seen.

        Nothing in it is changed afterwards; when nothing moved it is the same as before.
        """


def load_renderer(
    around: Surroundings, scenery: Scenery, robot: Callable[[], RobotModel], *, plain: bool, camera: Pinhole,
    arm: bool = False,
) -> Renderer:
    """What draws the world of the scenery's simulator for a camera.

    Args:
        around: fixtures and containers.
        scenery: the simulator and the light.
        robot: gives the robot; not asked when it is not in the picture.
        plain: for a camera that a drawn world shows without arm and depth.
        camera: intrinsics and pose.
        arm: have the arm in plain pictures, too.

    Raises:
        UnknownName: no such simulator; lists the choices.
        ConfigError: a module that cannot be imported, a mesh of the robot that is not there.
    """
    module = _module(scenery.simulator)
    if not hasattr(module, "renderer"):
        module = _module(KINEMATIC)
    made: Renderer = module.renderer(around, scenery, robot, plain=plain, camera=camera, arm=arm)
    return made


def _module(name: str) -> ModuleType:
    return find_plugin(GROUP, name, field="world.simulator", noun="simulator", marker="renderer")
