"""Proofs between bodies and motions of several arms, remembered while both exist."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.planning.arms.pair_world import ArmBody, PairWorld
from common.planning.arms.timed_pairs import ArmMotion, Clash, Effort, PairProof, Schedule
from common.planning.arms.touching import Touch

Array = NDArray[np.float64]

_MOST_WORLDS, _MOST_PROOFS = 16, 400
SAME_POSE = 0.002  # [rad] an arm at rest that moved less is where it was


@dataclass(frozen=True, eq=False)
class Moving:
    """A motion of a body; two of them are the same only if they are one object."""

    body: ArmBody
    motion: ArmMotion
    touch: Touch | None = None

    @property
    def arm(self) -> str:
        """Name of the arm."""
        return self.body.arm.name

    @property
    def enters(self) -> bool:
        """Whether its gripper is at what another arm carries when it ends."""
        return self.touch is not None and self.touch.end >= self.motion.duration - 1e-6


def resting(body: ArmBody, q: Array) -> Moving:
    """Return a body at rest at q (dof,) [rad]."""
    return Moving(body, ArmMotion.resting(q))


class Proofs:
    """Creates a proof for each pair of motions when it is needed first; the newest are remembered."""

    def __init__(self, clearance: float) -> None:
        """Keep this clearance [m]."""
        self.clearance = clearance
        self.effort = Effort()
        self._worlds: OrderedDict[tuple[int, int], PairWorld] = OrderedDict()
        self._proofs: OrderedDict[tuple[int, int], tuple[Moving, Moving, PairProof]] = OrderedDict()

    @property
    def exhausted(self) -> bool:
        """Whether answers since the effort was set may lack a proof that is only not finished."""
        return self.effort.left <= 0

    def in_time(self, one: Moving, at: Schedule, other: Moving, other_at: Schedule, band: float) -> Clash | None:
        """Return where two motions may come too close while their schedules differ by at most `band` [s], or None."""
        return self._between(one, other).in_time(at, other_at, band)

    def anywhere(
        self, one: Moving, other: Moving, one_range: tuple[float, float] | None = None,
        other_range: tuple[float, float] | None = None,
    ) -> Clash | None:
        """Return where they may come too close at any of these own times [s], by default all, or None."""
        return self._between(one, other).anywhere(
            one_range or (0.0, one.motion.duration), other_range or (0.0, other.motion.duration))

    def _between(self, one: Moving, other: Moving) -> PairProof:
        key = id(one), id(other)
        found = self._proofs.get(key)
        if found is None:
            proof = self._proof(one, other)
            found = self._proofs[key] = one, other, proof  # the motions are referenced: their ids stay unique
            if len(self._proofs) > _MOST_PROOFS:
                self._proofs.popitem(last=False)
        self._proofs.move_to_end(key)
        return found[2]

    def _proof(self, one: Moving, other: Moving) -> PairProof:
        world = self._world(one, other)
        allowed = [(arm, moving.touch.begin, moving.touch.end, world.gripper_on(arm, moving.touch.object))
                   for arm, (moving, rests) in enumerate(((one, other), (other, one)))
                   if moving.touch is not None and rests.motion.rests]
        return PairProof(world, one.motion, other.motion, self.clearance, self.effort, allowed)

    def _world(self, one: Moving, other: Moving) -> PairWorld:
        key = id(one.body), id(other.body)
        found = self._worlds.get(key)
        if found is None:
            found = self._worlds[key] = PairWorld(one.body, other.body)
            if len(self._worlds) > _MOST_WORLDS:
                self._worlds.popitem(last=False)
        self._worlds.move_to_end(key)
        return found
