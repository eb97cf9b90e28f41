"""Interface between the controller and a simulated world: kinematic, or with physics.

A simulator is a module (in this folder, in `drivers/`, or a user's dotted one) that `world.simulator` names, with

    def create(world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances,
               gripper: GripperConfig | None) -> SimulatedWorld

where each of the `objects` has a position, and `tolerances` define when the fingers grasp. It returns a
`GripperDrivenWorld`, or a `PhysicalWorld` that brings its own arm for robot files with the backend `mock`. Times are
cell time [s], passed as arguments. In the process of each camera, images are rendered from `scene_objects` and
`joint_states` by the module's

    def renderer(around: Surroundings, scenery: Scenery, robots: Callable[[], Sequence[RobotModel]], *, plain: bool,
                 camera: Pinhole, arm: bool) -> Renderer

and as for `kinematic` if it has none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import AliasChoices, BaseModel, ConfigDict, Field

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
KINEMATIC = "kinematic"  # the default; its renderer serves worlds without one


class ObjectSnapshot(BaseModel):
    """State of an object for a restart; poses are x, y, z [m] and a quaternion x, y, z, w.

    `definition` describes an object that an operator added; `like` names the object of the initial layout whose shape
    it shares. `details` belong to the simulator.
    """

    model_config = ConfigDict(populate_by_name=True)

    pose: Numbers
    definition: WorldObject | None = Field(None, validation_alias=AliasChoices("definition", "made"))
    like: str = ""
    details: dict[str, Any] = {}


class SimulatedWorld(Protocol):
    """Ground truth of a simulated world. `version` increases with every change.

    A world that supports conveyors has an attribute `belts` of the class `common.sim.conveyors.Belts`.
    """

    version: int

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as an operator requests; return the id of the changed object, empty for a reset.

        Raises:
            Refused: with the reason and the valid choices; nothing has changed.
        """

    @property
    def ids(self) -> list[str]:
        """Ids of all objects."""

    def objects(self, header: Header) -> WorldObjects:
        """State of all objects."""

    def take_events(self) -> list[SceneUpdate]:
        """Return objects removed or come to rest since the last call, in order."""

    @property
    def layout(self) -> dict[str, Numbers]:
        """Initial positions (x, y, z) [m] by id."""

    def snapshot(self) -> dict[str, ObjectSnapshot]:
        """Complete state, for `restore`."""

    def restore(self, objects: Mapping[str, ObjectSnapshot]) -> None:
        """Restore a state."""


@runtime_checkable
class GripperDrivenWorld(SimulatedWorld, Protocol):
    """A world without forces: others move the gripper, ask what obstructs it, and report its state."""

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """Width [m] below which the fingers cannot close: of the object between them, or 0.

        Args:
            T_world_tcp: (4, 4) pose of the tool center point.
            width: between the inner faces of the fingers, or the valve of a cup [m].
        """

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Advance to a time: grasp what the fingers press on, carry, release and drop it.

        Args:
            now: cell time [s].
            T_world_tcp: (4, 4) pose of the tool center point.
            width: between the fingers [m].
            gripping: whether the fingers press on something.
        """


@runtime_checkable
class PhysicalWorld(SimulatedWorld, Protocol):
    """A world with forces and its own arm; reading the arm advances it."""

    def hardware(self, robot: RobotModel, limits: Limits, start: Array) -> Hardware:
        """Return the arm in this world, at rest at `start` (dof,) [rad]. Called once, before anything but `layout`.

        Raises:
            ConfigError: the robot cannot be simulated.
        """


@runtime_checkable
class PhysicalWorldOfArms(PhysicalWorld, Protocol):
    """A world with forces and several arms, which are all in its model before the first one is read."""

    def arm(self, name: str, robot: RobotModel, limits: Limits, start: Array) -> Hardware:
        """Return one more arm in this world, at rest at `start` (dof,) [rad]; called once for each name.

        Raises:
            ConfigError: the robot cannot be simulated.
        """


class WorldOfGrippers(SimulatedWorld, Protocol):
    """A world without forces for several grippers."""

    def hand(self, arm: str, gripper: GripperConfig | None) -> GripperDrivenWorld:
        """Return the world as the gripper of an arm meets it; called once for each arm."""


class GraspTolerances(Parameters):
    """Where an object must be for the fingers to grasp it, in the frame of the tool center point."""

    across: Tunable[float] = Field(
        0.010, gt=0, le=0.05, description="half the width of a finger pad: offset from its center along tool x [m]"
    )
    along: Tunable[float] = Field(
        0.010, gt=0, le=0.05, description="half the height of a finger pad: offset from its center along tool z [m]"
    )
    sideways: Tunable[float] = Field(
        0.002, ge=0, le=0.05, description="allowed overlap of an object with an open finger along tool y [m]"
    )
    release: Tunable[float] = Field(0.002, gt=0, le=0.02, description="opening beyond the object that releases it [m]")


class Simulator(Protocol):
    """A module that simulates a world."""

    def create(
        self, world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances,
        gripper: GripperConfig | None, /,
    ) -> SimulatedWorld:
        """Create the world with objects that all have a position."""


def load_world(
    world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances | None = None,
    gripper: GripperConfig | None = None,
) -> SimulatedWorld:
    """Create the world of the simulator that `world.simulator` names, with objects that all have a position.

    Without a gripper, fingers close along the tool's y axis.

    Raises:
        UnknownName: no such simulator; lists the choices.
        ConfigError: the module cannot be imported or is no simulator, or an object cannot be at its position.
    """
    module = _module(world.simulator)
    if not hasattr(module, "create"):
        raise ConfigError("world.simulator", world.simulator, "is no simulator: it has no create")
    return cast(Simulator, module).create(world, objects, tolerances or GraspTolerances(), gripper)


def require_simulator(name: str) -> None:
    """Check that a simulator exists and that its own `require`, if any, is satisfied.

    Raises:
        UnknownName: no such simulator; lists the choices.
        ConfigError: the module cannot be imported, or a package is missing.
    """
    if name != KINEMATIC:
        require = getattr(_module(name), "require", None)
        if require is not None:
            require()


class Renderer(Protocol):
    """Renders one camera. Calls may block and may come from any thread, one at a time."""

    camera: Pinhole
    needs_arm: bool
    """Whether arms are visible, so that `render` needs their joint states."""

    @property
    def level(self) -> Array:
        """(3,) [lx] of blue, green and red light at which a white surface has the value 255."""

    def move_camera(self, camera: Pinhole) -> None:
        """Move the camera; its intrinsics stay."""

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery."""

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Whether rendering the objects may take long."""

    def render(self, objects: Sequence[WorldObject], *joints: JointState | None) -> View:
        """Return the view of the objects, and of each arm, in the order of creation, if its joint state is complete.

        Objects in state "elsewhere" are not shown. A view is never modified; an unchanged scene returns the same one.
        """


def load_renderer(
    around: Surroundings, scenery: Scenery, robots: Callable[[], Sequence[RobotModel]], *, plain: bool, camera: Pinhole,
    arm: bool = False,
) -> Renderer:
    """Create the renderer of the scenery's simulator for a camera.

    Args:
        around: fixtures and containers.
        scenery: the simulator and the light.
        robots: returns the models of all arms; called only if they are visible.
        plain: for a camera whose simplified images need neither arm nor depth.
        camera: intrinsics and pose.
        arm: show the arms in plain images, too.

    Raises:
        UnknownName: no such simulator; lists the choices.
        ConfigError: the module cannot be imported, or a mesh of the robot is missing.
    """
    module = _module(scenery.simulator)
    if not hasattr(module, "renderer"):
        module = _module(KINEMATIC)
    created: Renderer = module.renderer(around, scenery, robots, plain=plain, camera=camera, arm=arm)
    return created


def _module(name: str) -> ModuleType:
    return find_plugin(GROUP, name, field="world.simulator", noun="simulator", marker="renderer")
