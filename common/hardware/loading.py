"""Hardware backends by name."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from dataclasses import dataclass

from common.config import RobotConfig, check
from common.errors import ConfigError, UnknownName
from common.hardware.interface import Hardware, Limits, Vector

PACKAGE = "common.hardware"


@dataclass(frozen=True)
class LoadedHardware:
    """A backend that was created, and whether the simulated world goes with it."""

    hardware: Hardware
    simulated: bool


def backend_names() -> list[str]:
    """Backends that come with the project: the modules of this folder that create one."""
    folder = importlib.import_module(PACKAGE).__path__
    names = [found.name for found in pkgutil.iter_modules(folder)]
    return sorted(name for name in names if hasattr(importlib.import_module(f"{PACKAGE}.{name}"), "create"))


def load_hardware(robot: RobotConfig, limits: Limits, start: Vector) -> LoadedHardware:
    """The backend that `robot.hardware` names, created with its options.

    Args:
        robot: its `hardware.backend` is a module of common.hardware, or a dotted module of the user's own.
        limits: of the arm's joints.
        start: where a simulated arm begins, (dof,) [rad].

    Raises:
        UnknownName: no such backend; lists the choices.
        ConfigError: a module that is no backend, or an option that does not fit.
    """
    name = robot.hardware.backend
    if "." not in name and name not in backend_names():
        raise UnknownName("hardware backend", name, backend_names())
    try:
        module = importlib.import_module(name if "." in name else f"{PACKAGE}.{name}")
    except ImportError as error:
        raise ConfigError("robot.hardware.backend", name, f"can not be imported: {error}") from None
    missing = [part for part in ("Options", "create", "simulated") if not hasattr(module, part)]
    if missing:
        raise ConfigError("robot.hardware.backend", name, f"is no backend: it has no {', '.join(missing)}")
    options = check(module.Options, robot.hardware.options, "robot.hardware.options")
    return LoadedHardware(module.create(robot, limits, start, options), bool(module.simulated))
