"""The grippers of several arms in one kinematic world: what is between the fingers of each."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig
from common.robot.finger_joints import closing_frame
from common.robot.transforms import invert
from common.sim.bodies import Body
from common.sim.interface import SimulatedWorld

Array = NDArray[np.float64]


class Hand:
    """One gripper.

    Attributes:
        arm: its name; empty in a world with one.
        T_tcp_closing: (4, 4) frame whose y axis the fingers close along.
        between: ends along that axis [m] of the bodies between the fingers.
        T: (4, 4) newest pose of that frame in world.
    """

    def __init__(self, arm: str, gripper: GripperConfig | None) -> None:
        """Describe a gripper with nothing between its fingers."""
        self.arm, self.gripper = arm, gripper
        self.T_tcp_closing: Array = closing_frame(gripper) if gripper else np.eye(4)
        self.between: dict[str, tuple[float, float]] = {}
        self.T: Array | None = None

    def take(self, body: Body) -> None:
        """Hold a body that the gripper presses on and another one has released."""
        assert self.T is not None
        low, high = self.between.pop(body.name)
        body.grip, body.holder, body.second = invert(self.T) @ body.T, self.arm, ""
        body.width = 2 * body.solid.radius if body.solid.shape == "sphere" else high - low
        body.changed()


class WorldOfHands(SimulatedWorld, Protocol):
    """A world that several grippers act on."""

    def obstruction_of(self, hand: Hand, T_world_tcp: Array, width: float) -> float:
        """Width [m] below which the fingers of one gripper cannot close."""

    def takes_long_for(self, hand: Hand, width: float, gripping: bool) -> bool:
        """Whether the next tick of one gripper may take longer than a control cycle."""

    def tick_of(self, hand: Hand, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Advance to a time with one of the grippers."""


class HandInWorld:
    """A kinematic world as one of several grippers meets it: see `common.sim.interface.GripperDrivenWorld`."""

    def __init__(self, world: WorldOfHands, hand: Hand) -> None:
        """Let this gripper act on the world."""
        self._world, self._hand = world, hand

    def __getattr__(self, name: str) -> Any:
        """Return what all grippers share."""
        return getattr(self._world, name)

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """Width [m] below which the fingers cannot close."""
        return self._world.obstruction_of(self._hand, T_world_tcp, width)

    def takes_long(self, width: float, gripping: bool) -> bool:
        """Whether the next `tick` may take longer than a control cycle."""
        return self._world.takes_long_for(self._hand, width, gripping)

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Advance to a time with this gripper."""
        self._world.tick_of(self._hand, now, T_world_tcp, width, gripping)
