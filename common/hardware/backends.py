"""Backends: find the module that a robot file names, check its options, create arm and gripper.

An arm backend is a module (in this folder, in drivers/, an installed entry point or a dotted module of the user) with

    simulated: bool          # whether the arm itself is simulated
    class Options(Parameters)
    def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> Hardware
    def has_simulated_world(options: Options) -> bool  # optional, for a real arm: whether cameras and objects around it
                                                       # are simulated; a simulated arm always has a simulated world
    def identity(options: Options) -> str              # optional, for a real arm: its address or serial number, to
                                                       # which its interlocks belong; without it they belong to the cell
    def max_payload(options: Options) -> float         # optional: rated payload [kg], which no gripper may exceed

`start` is the pose at which a simulated arm starts; a real arm is where it is. A gripper backend has `GripperOptions`
and `create_gripper(gripper: GripperConfig, options: GripperOptions) -> Gripper`; one module may be both.
"""

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
    """A module that moves joints: see above."""

    simulated: bool
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
    if not isinstance(module.simulated, bool):
        raise ConfigError("robot.hardware.backend", name, "is no backend: `simulated` must be True or False; the world "
                          "around a real arm may be simulated: `has_simulated_world(options)` says so")
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
    """Return whether the arm itself is simulated: then no interlock of it needs to outlive a deliberate new run.

    Raises:
        UnknownName, ConfigError: no such backend.
    """
    return find_backend(robot).simulated


def has_simulated_world(robot: RobotConfig) -> bool:
    """Return whether the surroundings of the arm are simulated, which a real arm's backend may have an option for.

    Raises:
        UnknownName, ConfigError: no such backend, also of the gripper, or an invalid option.
    """
    backend, options = _checked_backend(robot)
    if robot.gripper is not None and robot.gripper.hardware is not None:
        _gripper_options(find_gripper_backend(robot.gripper.hardware), robot.gripper.hardware)
    decide = getattr(backend, "has_simulated_world", None)
    return backend.simulated or (decide is not None and decide(options))


def real_arm(robot: RobotConfig) -> str | None:
    """Return what identifies a real arm, such as `ur-192.168.0.5`; None: it is simulated, or its backend cannot say.

    Raises:
        UnknownName, ConfigError: no such backend, or an invalid option.
    """
    backend, options = _checked_backend(robot)
    identify = getattr(backend, "identity", None)
    return None if backend.simulated or identify is None else f"{robot.hardware.backend}-{identify(options)}".lower()


def load_hardware(
    robot: RobotConfig, limits: Limits, start: Vector, world_arm: Callable[[], Hardware] | None = None
) -> Hardware:
    """Create the robot's arm and gripper with the options of the robot file.

    A simulated world with forces has an arm of its own, `world_arm`, which replaces `mock`. A backend that wraps
    another arm has `around(robot, limits, start, options, world_arm)` to wrap that one. The gripper is the one of
    `robot.gripper.hardware`, by default the one that the arm's backend brings.

    Raises:
        UnknownName, ConfigError: no such backend, an invalid option, a gripper heavier than the rated payload, or a
            backend that moves the joints itself in a world that does.
    """
    _require_rated(robot)
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


def _checked_backend(robot: RobotConfig) -> tuple[Backend, Parameters]:
    backend = find_backend(robot)
    return backend, check(backend.Options, robot.hardware.options, "robot.hardware.options")


def _gripper_options(backend: GripperBackend, hardware: HardwareConfig) -> Parameters:
    return check(backend.GripperOptions, hardware.options, f"{GRIPPER_FIELD}.options")


def _require_rated(robot: RobotConfig) -> None:
    backend, options = _checked_backend(robot)
    payload = robot.gripper.payload if robot.gripper is not None else None
    if payload is None or not hasattr(backend, "max_payload"):
        return
    if payload.mass > (most := backend.max_payload(options)):
        raise ConfigError("robot.gripper.payload.mass", payload.mass,
                          f"exceeds the rated payload of the arm, {most:g} kg")


def _load_arm(
    robot: RobotConfig, limits: Limits, start: Vector, world_arm: Callable[[], Hardware] | None
) -> Hardware:
    backend, options = _checked_backend(robot)
    if world_arm is None:
        return backend.create(robot, limits, start, options)
    if hasattr(backend, "around"):
        return cast(Hardware, backend.around(robot, limits, start, options, world_arm))
    if robot.hardware.backend != DEFAULT:
        raise ConfigError("robot.hardware.backend", robot.hardware.backend, f"moves the joints itself, and so does "
                          f"world.simulator: set {DEFAULT} here, or kinematic there")
    return world_arm()
