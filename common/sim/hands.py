"""The grippers of several arms in one kinematic world: what is between the fingers of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig
from common.messages import Header, SceneUpdate, WorldEdit, WorldObjects
from common.robot.finger_joints import closing_frame
from common.robot.transforms import invert
from common.sim.bodies import Body
from common.sim.interface import Numbers, ObjectSnapshot, SimulatedWorld

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

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Whether an edit may take longer than a control cycle."""

    @property
    def no_seal(self) -> str:
        """Why a suction cup does not seal on anything, by the newest `obstruction_of`."""


class HandInWorld:
    """A kinematic world as one of several grippers meets it: see `common.sim.interface.GripperDrivenWorld`."""

    def __init__(self, world: WorldOfHands, hand: Hand) -> None:
        """Let this gripper act on the world."""
        self._world, self._hand = world, hand

    @property
    def version(self) -> int:
        """Increases with every change of the world."""
        return self._world.version

    @property
    def no_seal(self) -> str:
        """Why a suction cup does not seal on anything, by the newest `obstruction`; empty if it does."""
        return self._world.no_seal

    @property
    def ids(self) -> list[str]:
        """Ids of all objects."""
        return self._world.ids

    @property
    def layout(self) -> dict[str, Numbers]:
        """Initial positions (x, y, z) [m] by id."""
        return self._world.layout

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """Width [m] below which the fingers cannot close."""
        return self._world.obstruction_of(self._hand, T_world_tcp, width)

    def takes_long(self, width: float, gripping: bool) -> bool:
        """Whether the next `tick` may take longer than a control cycle."""
        return self._world.takes_long_for(self._hand, width, gripping)

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Advance to a time with this gripper."""
        self._world.tick_of(self._hand, now, T_world_tcp, width, gripping)

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Whether an edit may take longer than a control cycle."""
        return self._world.edit_takes_long(request)

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as an operator requests."""
        return self._world.edit(request, now)

    def objects(self, header: Header) -> WorldObjects:
        """State of all objects."""
        return self._world.objects(header)

    def take_events(self) -> list[SceneUpdate]:
        """Return objects removed or come to rest since the last call, in order."""
        return self._world.take_events()

    def snapshot(self) -> dict[str, ObjectSnapshot]:
        """Complete state, for `restore`."""
        return self._world.snapshot()

    def restore(self, objects: Mapping[str, ObjectSnapshot]) -> None:
        """Restore a state."""
        self._world.restore(objects)
