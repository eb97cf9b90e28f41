"""A hardware backend that shows every set-point to who looks on, before it passes it to the simulated arm below it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from common.config import Cell, HardwareConfig, Parameters, RobotConfig
from common.errors import ConfigError
from common.hardware.interface import Gripper, Hardware, Limits, Vector
from common.hardware.loading import find_backend, load_hardware

simulated = True
SetPoint = Callable[[Limits, Vector, Vector, Vector, float], None]  # measured, then commanded q [rad], dq, cell time


class Options(Parameters):
    """The backend below, with its options."""

    backend: str
    options: dict[str, Any]


class _Shown:
    look: SetPoint | None = None


class ObservedArm:
    """An arm of whose set-points none goes unseen."""

    def __init__(self, below: Hardware, limits: Limits) -> None:
        """Look on."""
        self._below, self._limits = below, limits
        self._measured: Vector | None = None
        self.gripper: Gripper | None = below.gripper

    def read(self, now: float) -> tuple[Vector, Vector]:
        """What the arm below measures."""
        measured = self._below.read(now)
        self._measured = measured[0]
        return measured

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Show the set-points and pass them on."""
        if _Shown.look is not None:
            measured = positions if self._measured is None else self._measured
            _Shown.look(self._limits, measured, positions, velocities, now)
        self._below.write(positions, velocities, now)

    def close(self) -> None:
        """Let go of the arm below."""
        self._below.close()


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> ObservedArm:
    """The arm of the backend below."""
    below = robot.model_copy(update={"hardware": HardwareConfig(backend=options.backend, options=options.options)})
    return ObservedArm(load_hardware(below, limits, start), limits)


def around(
    robot: RobotConfig, limits: Limits, start: Vector, options: Options, arm: Callable[[], Hardware]
) -> ObservedArm:
    """The arm of a simulated world, which takes the place of the backend below."""
    below = robot.model_copy(update={"hardware": HardwareConfig(backend=options.backend, options=options.options)})
    return ObservedArm(load_hardware(below, limits, start, arm), limits)


def with_observed_arm(cell: Cell) -> Cell:
    """The cell with its arm being watched.

    Raises:
        ConfigError: its arm is a real one, for which time cannot stand still.
    """
    hardware = cell.robot.hardware
    if find_backend(cell.robot).simulated is not True:  # one that talks to an arm has a clock of its own
        raise ConfigError("robot.hardware.backend", hardware.backend, "is a real arm: simulate needs a simulated one")
    watched = HardwareConfig(backend=__name__, options={"backend": hardware.backend, "options": hardware.options})
    return cell.model_copy(update={"robot": cell.robot.model_copy(update={"hardware": watched})})


@contextmanager
def observe_set_points(look: SetPoint) -> Iterator[None]:
    """Inside, `look` sees every set-point."""
    before, _Shown.look = _Shown.look, look
    try:
        yield
    finally:
        _Shown.look = before
