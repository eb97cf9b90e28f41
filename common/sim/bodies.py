"""What there is in the kinematic world, and what is to be said about each body and kept of it over a restart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from common.messages import WorldObject
from common.robot.transforms import matrix_to_quaternion, quaternion_to_matrix, transform
from common.sim.footprints import apart, convex_parts, parts_meet
from common.sim.interface import StandingObject
from common.sim.objects import Solid, object_message
from common.sim.table import Slot

Array = NDArray[np.float64]
State = Literal["table", "held", "falling", "contained", "elsewhere"]


@dataclass(frozen=True)
class Rest:
    """Where a body lies: its pose (4, 4) in world, and the container and slot if it lies in one."""

    T: Array
    state: State = "table"
    container: str = ""
    slot: Slot | None = None


@dataclass(eq=False)
class Body:
    """A solid and what is done to it. Held: `grip` is its pose in the TCP frame. Falling: it is to lie at `rest`."""

    name: str
    solid: Solid
    color: tuple[float, float, float]
    T: Array
    state: State = "table"
    container: str = ""
    slot: Slot | None = None
    grip: Array | None = None
    width: float = 0.0  # between the fingers that hold it [m]
    dropped: float = 0.0  # height at which it began to fall [m]
    since: float = 0.0  # when [s]
    rest: Rest | None = None
    added: bool = False  # by a person
    like: str = ""  # the object of the first layout whose shape it has
    told: WorldObject | None = None  # the message about it, while it is as it was
    kept: StandingObject | None = None  # the same of how it stands

    def lie(self, rest: Rest) -> None:
        """Be at rest there."""
        self.T, self.state, self.container, self.slot = rest.T, rest.state, rest.container, rest.slot
        self.rest, self.grip = None, None
        self.changed()

    def changed(self) -> None:
        """Forget what was said about it: it is not as it was."""
        self.told = self.kept = None

    @property
    def lying(self) -> Array:
        """Its pose (4, 4), or that to which it falls."""
        return self.T if self.rest is None else self.rest.T

    @property
    def slot_taken(self) -> tuple[str, Slot] | None:
        """The container and slot in which it lies or will lie."""
        return None if self.slot_in is None else (self.container_taken, self.slot_in)

    @property
    def bottom(self) -> float:
        """Height of its lowest point where it lies or will lie [m]."""
        return float(self.lying[2, 3]) + self.solid.lowest(self.lying[:3, :3])

    def message(self) -> WorldObject:
        """What there is to say about it."""
        if self.told is None:
            self.told = object_message(self.name, self.solid, self.T, self.color, state=self.state,
                                   container=self.container)
        return self.told

    @property
    def container_taken(self) -> str:
        """The container in which it lies or will lie, or an empty string."""
        return self.container if self.rest is None else self.rest.container

    @property
    def slot_in(self) -> Slot | None:
        """The slot in which it lies or will lie."""
        return self.slot if self.rest is None else self.rest.slot

    def block(self) -> Block:
        """What others can lie on."""
        T = self.lying
        low, high = (float(T[2, 3]) + end for end in (self.solid.lowest(T[:3, :3]), self.solid.highest(T[:3, :3])))
        outline = self.solid.footprint(T[:3, :3]) + T[:2, 3]
        return Block(self.name, outline, low, high, flat=self.solid.shape != "sphere")

    def standing(self) -> StandingObject:
        """All of it, for `restored`."""
        if self.kept is None:
            rest = self.rest
            self.kept = StandingObject(
                pose=_numbers(self.T), like=self.like, made=self.message() if self.added and not self.like else None,
                details={
                    "state": self.state, "container": self.container, "slot": self.slot, "dropped": self.dropped,
                    "since": self.since, "width": self.width, "added": self.added,
                    "grip": None if self.grip is None else _numbers(self.grip),
                    "rest": None if rest is None else [_numbers(rest.T), rest.state, rest.container, rest.slot],
                },
            )
        return self.kept


@dataclass(frozen=True, eq=False)
class Block:
    """Something that is in the way or carries: its outline (N, 2) [m] and between which heights [m] it is."""

    id: str
    outline: Array
    low: float
    high: float
    flat: bool  # its top carries things

    @cached_property
    def parts(self) -> Array:
        """Its outline in convex parts (n, K, 2) [m]."""
        return convex_parts(self.outline)

    def reaches(self, outline: Array, parts: Array | None = None) -> bool:
        """Whether it covers some of an area seen from above, of which convex parts (m, N, 2) [m] may be given."""
        return not apart(outline, self.outline) and parts_meet(
            convex_parts(outline) if parts is None else parts, self.parts)


def restored(name: str, kept: StandingObject, solid: Solid, color: tuple[float, float, float]) -> Body:
    """A body as it stood."""
    d: dict[str, Any] = kept.details
    body = Body(
        name, solid, color, _matrix(kept.pose), d["state"], d["container"], _slot(d["slot"]),
        None if d["grip"] is None else _matrix(d["grip"]), d["width"], d["dropped"], d["since"],
        added=d["added"], like=kept.like,
    )
    if d["rest"] is not None:
        T, state, container, slot = d["rest"]
        body.rest = Rest(_matrix(T), state, container, _slot(slot))
    return body


def _numbers(T: Array) -> tuple[float, ...]:
    return (*T[:3, 3].tolist(), *matrix_to_quaternion(T[:3, :3]))


def _matrix(numbers: Sequence[float]) -> Array:
    x, y, z, *q = numbers
    return transform(quaternion_to_matrix(*q), (x, y, z))


def _slot(value: Any) -> Slot | None:
    return None if value is None else (int(value[0]), int(value[1]))
