"""Find hardware backends by name: arms and grippers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from common.config import GripperConfig, HardwareConfig, Parameters, RobotConfig, check
from common.errors import ConfigError, UnknownName
from common.hardware.interface import Gripper, Hardware, Limits, Vector
from common.plugins import find_plugin, plugin_names

ARMS, GRIPPERS = "zencell.hardware", "zencell.grippers"  # groups of plug-ins
WORLDS = ("mujoco",)  # simulators that operators look for among the backends
DEFAULT = "mock"  # replaced by the arm of a simulated world, where that has one
GRIPPER_FIELD = "robot.gripper.hardware"


class Backend(Protocol):
    """A module that moves joints: see common.hardware.interface."""

    simulated: bool | Callable[[Any], bool]
    Options: type[Parameters]

    def create(self, robot: RobotConfig, limits: Limits, start: Vector, options: Any, /) -> Hardware:
        """Create the hardware; a simulated arm starts at `start` (dof,) [rad]."""


class GripperBackend(Protocol):
    """A module that moves a gripper, on any arm."""

    GripperOptions: type[Parameters]

    def create_gripper(self, gripper: GripperConfig, options: Any, /) -> Gripper:
        """Create the gripper."""


def backend_names() -> list[str]:
    """Return the plain names of all arm backends."""
    return [name for name in plugin_names(ARMS, "create") if name not in WORLDS]


def gripper_backend_names() -> list[str]:
    """Return the plain names of all gripper backends."""
    return plugin_names(GRIPPERS, "create_gripper")


def find_backend(robot: RobotConfig) -> Backend:
    """Return the module that `robot.hardware.backend` names: a plug-in, or a dotted module of the user.

    Raises:
        UnknownName: no such backend; lists the choices.
        ConfigError: a module that cannot be imported, or is no backend.
    """
    name = robot.hardware.backend
    if name in WORLDS:
        raise ConfigError("robot.hardware.backend", name, "is a simulated world with an arm in it: leave the "
                          f"backend at {DEFAULT} and set world.simulator: {name} in the cell")
    if "." not in name and name not in (choices := backend_names()):
        raise UnknownName("hardware backend", name, choices)
    module = find_plugin(ARMS, name, field="robot.hardware.backend", noun="hardware backend", marker="create")
    missing = [part for part in ("Options", "create", "simulated") if not hasattr(module, part)]
    if missing:
        raise ConfigError("robot.hardware.backend", name, f"is no backend: it has no {', '.join(missing)}")
    return cast(Backend, module)


def find_gripper_backend(hardware: HardwareConfig) -> GripperBackend:
    """Return the module that `robot.gripper.hardware.backend` names: a plug-in, or a dotted module of the user.

    Raises:
        UnknownName: no such backend; lists the choices.
        ConfigError: a module that cannot be imported, or is no gripper backend.
    """
    name, field = hardware.backend, f"{GRIPPER_FIELD}.backend"
    module = find_plugin(GRIPPERS, name, field=field, noun="gripper backend", marker="create_gripper")
    missing = [part for part in ("GripperOptions", "create_gripper") if not hasattr(module, part)]
    if missing:
        raise ConfigError(field, name, f"is no gripper backend: it has no {', '.join(missing)}")
    return cast(GripperBackend, module)


def is_simulated(robot: RobotConfig) -> bool:
    """Return whether a simulated world belongs to the robot's hardware; some backends have an option for that.

    Raises:
        UnknownName, ConfigError: no such backend, also of the gripper, or an invalid option.
    """
    backend = find_backend(robot)
    if robot.gripper is not None and robot.gripper.hardware is not None:
        _gripper_options(find_gripper_backend(robot.gripper.hardware), robot.gripper.hardware)
    if callable(backend.simulated):
        return backend.simulated(check(backend.Options, robot.hardware.options, "robot.hardware.options"))
    return backend.simulated


def load_hardware(
    robot: RobotConfig, limits: Limits, start: Vector, world_arm: Callable[[], Hardware] | None = None
) -> Hardware:
    """Create the robot's arm and gripper with the options of the robot file.

    A simulated world with forces has an arm of its own, `world_arm`, which replaces `mock`. A backend that wraps
    another arm has `around(robot, limits, start, options, world_arm)` to wrap that one. The gripper is the one of
    `robot.gripper.hardware`, by default the one that the arm's backend brings.

    Raises:
        UnknownName, ConfigError: no such backend, an invalid option, or a backend that moves the joints itself in a
            world that does.
    """
    own = robot.gripper.hardware if robot.gripper is not None else None
    if robot.gripper is None or own is None:
        return _load_arm(robot, limits, start, world_arm)
    backend = find_gripper_backend(own)
    if world_arm is not None:
        raise ConfigError(f"{GRIPPER_FIELD}.backend", own.backend, "moves the gripper, and so does world.simulator: "
                          "leave it out, or set world.simulator to kinematic")
    options = _gripper_options(backend, own)
    arm = _load_arm(robot.model_copy(update={"gripper": None}), limits, start, None)
    arm.gripper = backend.create_gripper(robot.gripper, options)
    return arm


def _gripper_options(backend: GripperBackend, hardware: HardwareConfig) -> Parameters:
    return check(backend.GripperOptions, hardware.options, f"{GRIPPER_FIELD}.options")


def _load_arm(
    robot: RobotConfig, limits: Limits, start: Vector, world_arm: Callable[[], Hardware] | None
) -> Hardware:
    backend = find_backend(robot)
    options = check(backend.Options, robot.hardware.options, "robot.hardware.options")
    if world_arm is None:
        return backend.create(robot, limits, start, options)
    if hasattr(backend, "around"):
        return cast(Hardware, backend.around(robot, limits, start, options, world_arm))
    if robot.hardware.backend != DEFAULT:
        raise ConfigError("robot.hardware.backend", robot.hardware.backend, f"moves the joints itself, and so does "
                          f"world.simulator: set {DEFAULT} here, or kinematic there")
    return world_arm()
