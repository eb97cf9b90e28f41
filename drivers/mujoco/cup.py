"""The suction cup of the physics world: an adhesion actuator that pulls while the valve is open and the lip seals."""

from __future__ import annotations

from collections.abc import Callable

import mujoco

from common.config import GripperConfig
from common.hardware.interface import GripperReading
from common.hardware.mock import SAME_WIDTH, SimulatedFingers
from drivers.mujoco.model import CellModel
from drivers.mujoco.scene import LIP

Seal = Callable[[], tuple[str, str]]
"""Returns the object that the cup seals on, or an empty name and why it seals on none."""


class PhysicsCup:
    """A suction cup. It holds an object while its valve is open and the object stays at the lip.

    Attributes:
        held: id of the held object, or empty.
    """

    def __init__(self, config: GripperConfig, seal: Seal, before: str) -> None:
        """Start with a closed valve; `seal` finds the object that the lip is on; its actuator is `before` + LIP."""
        assert config.cup is not None
        self._config, self._force, self._seal = config, config.cup.force, seal
        self._valve, self._actuator_name = SimulatedFingers(config), before + LIP
        self._sealed, self.held = "", ""

    def attach(self, cell: CellModel, data: mujoco.MjData) -> None:
        """Pull with the actuator of this model."""
        self._data, self._actuator = data, cell.actuators[self._actuator_name]

    def command(self, width: float, now: float, effort: float) -> None:
        """Open the valve at width 0, close it at the largest; the vacuum determines the force."""
        self._valve.command(width, now, effort)

    def read(self, now: float) -> GripperReading:
        """Return the state of the cup after the last step."""
        reading = self._valve.read(now)
        return reading._replace(effort=round(self._force, 1) if reading.holding else 0.0)

    def place(self, width: float) -> None:
        """Set the valve at rest at a width [m]."""
        self._valve.place(width)

    def drive(self, now: float) -> None:
        """Set the force before a step."""
        draws = self._valve.read(now).width <= self._config.held_width + SAME_WIDTH
        self._data.ctrl[self._actuator] = 1.0 if draws and self._sealed else 0.0

    @property
    def pulls(self) -> bool:
        """Whether the actuator pulls."""
        return bool(self._data.ctrl[self._actuator])

    def sense(self, now: float) -> None:
        """Find out after steps what the lip seals on."""
        self._sealed, self._valve.no_seal = self._seal()
        self._valve.obstruct(self._config.held_width if self._sealed else 0.0)
        self.held = self._sealed if self._valve.read(now).holding else ""
