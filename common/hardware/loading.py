"""Hardware backends by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from common.config import Parameters, RobotConfig, check
from common.errors import ConfigError, UnknownName
from common.hardware.interface import Hardware, Limits, Vector
from common.plugins import find_plugin, plugin_names

GROUP = "zencell.hardware"
WORLDS = ("mujoco",)  # simulators that are looked for here
STANDS_IN = "mock"  # for the arm of a simulated world, where that has one


def backend_names() -> list[str]:
    """Return the plain names of all backends."""
    return [name for name in plugin_names(GROUP, "create") if name not in WORLDS]


class Backend(Protocol):
    """A module that moves joints: see common.hardware.interface."""

    simulated: bool | Callable[[Any], bool]
    Options: type[Parameters]

    def create(self, robot: RobotConfig, limits: Limits, start: Vector, options: Any, /) -> Hardware:
        """The hardware; a simulated arm begins at `start` (dof,) [rad]."""


def find_backend(robot: RobotConfig) -> Backend:
    """The module that `robot.hardware.backend` names: one of common.hardware, or a dotted one of the user's own.

    Raises:
        UnknownName: no such backend; lists the choices.
        ConfigError: a module that cannot be imported, or is no backend.
    """
    name = robot.hardware.backend
    if name in WORLDS:
        raise ConfigError("robot.hardware.backend", name, "is a simulated world with an arm in it: leave the "
                          f"backend at {STANDS_IN} and say world.simulator: {name} in the cell")
    if "." not in name and name not in (choices := backend_names()):
        raise UnknownName("hardware backend", name, choices)
    module = find_plugin(GROUP, name, field="robot.hardware.backend", noun="hardware backend", marker="create")
    missing = [part for part in ("Options", "create", "simulated") if not hasattr(module, part)]
    if missing:
        raise ConfigError("robot.hardware.backend", name, f"is no backend: it has no {', '.join(missing)}")
    return cast(Backend, module)


def is_simulated(robot: RobotConfig) -> bool:
    """Whether the simulated world goes with the robot's hardware; some backends leave that to their options.

    Raises:
        UnknownName, ConfigError: no such backend, or an option that does not fit.
    """
    backend = find_backend(robot)
    if callable(backend.simulated):
        return backend.simulated(check(backend.Options, robot.hardware.options, "robot.hardware.options"))
    return backend.simulated


def load_hardware(
    robot: RobotConfig, limits: Limits, start: Vector, arm: Callable[[], Hardware] | None = None
) -> Hardware:
    """The robot's hardware, created with the options of the robot file.

    A simulated world with forces has an `arm` of its own, which takes the place of `mock`: what looks on at a backend
    has `around(robot, limits, start, options, arm)` to look on at that.

    Raises:
        UnknownName, ConfigError: no such backend, an option that does not fit, or a backend that moves the joints
            itself in a world that does.
    """
    backend = find_backend(robot)
    options = check(backend.Options, robot.hardware.options, "robot.hardware.options")
    if arm is None:
        return backend.create(robot, limits, start, options)
    if hasattr(backend, "around"):
        return cast(Hardware, backend.around(robot, limits, start, options, arm))
    if robot.hardware.backend != STANDS_IN:
        raise ConfigError("robot.hardware.backend", robot.hardware.backend, f"moves the joints itself, and so does "
                          f"world.simulator: use {STANDS_IN} here, or kinematic there")
    return arm()
