"""Bodies of a simulated world: state, message and snapshot of each, the events of all, and what the gripper holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from common.messages import Pose, SceneUpdate, Vector3, WorldObject
from common.robot.transforms import invert, matrix_to_pose, matrix_to_quaternion, quaternion_to_matrix, transform
from common.sim.footprints import boxes_disjoint, convex_parts, parts_meet
from common.sim.interface import GraspTolerances, ObjectSnapshot
from common.sim.objects import Solid, object_message
from common.sim.table import Slot

Array = NDArray[np.float64]
State = Literal["table", "held", "falling", "contained", "elsewhere"]


@dataclass(frozen=True)
class Rest:
    """Rest pose of a body (4, 4) in world, and the container and slot that hold it."""

    T: Array
    state: State = "table"
    container: str = ""
    slot: Slot | None = None


@dataclass(eq=False)
class Body:
    """A solid and its state. Held: `grip` is its pose in the TCP frame. Falling: it comes to rest at `rest`."""

    name: str
    solid: Solid
    color: tuple[float, float, float]
    T: Array
    state: State = "table"
    container: str = ""
    slot: Slot | None = None
    grip: Array | None = None
    width: float = 0.0  # of the fingers that hold it [m]
    drop_height: float = 0.0  # where the fall started [m]
    drop_time: float = 0.0  # when the fall started [s]
    rest: Rest | None = None
    added: bool = False  # by an operator
    like: str = ""  # id of the object of the initial layout whose shape it shares
    mass: float = 0.0  # [kg]; 0: unknown
    holder: str = ""  # arm that holds it, in a world with several
    second: str = ""  # arm whose gripper presses on it too, and takes it over when the holder releases it
    _message: WorldObject | None = None  # cached until the body changes
    _snapshot: ObjectSnapshot | None = None  # cached until the body changes

    def rest_at(self, rest: Rest) -> None:
        """Put the body at rest."""
        self.T, self.state, self.container, self.slot = rest.T, rest.state, rest.container, rest.slot
        self.rest, self.grip, self.holder, self.second = None, None, "", ""
        self.changed()

    def changed(self) -> None:
        """Invalidate the cached message and snapshot."""
        self._message = self._snapshot = None

    def carry(self, T_world_hand: Array) -> bool:
        """Move a held body with the frame (4, 4) of its grip; return whether it has moved."""
        assert self.grip is not None
        T = T_world_hand @ self.grip
        if self.solid.shape == "sphere":
            T[:3, :3] = self.T[:3, :3]
        moved = not np.array_equal(T, self.T)
        if moved:
            self.T = T
            self.changed()
        return moved

    @property
    def rest_pose(self) -> Array:
        """Its pose (4, 4), or its future rest pose while it falls."""
        return self.T if self.rest is None else self.rest.T

    @property
    def slot_taken(self) -> tuple[str, Slot] | None:
        """Container and slot that it occupies or will occupy."""
        return None if self.slot_in is None else (self.container_taken, self.slot_in)

    @property
    def bottom(self) -> float:
        """Height of its lowest point at rest [m]."""
        return float(self.rest_pose[2, 3]) + self.solid.lowest(self.rest_pose[:3, :3])

    def message(self) -> WorldObject:
        """Message that describes the body."""
        if self._message is None:
            self._message = object_message(self.name, self.solid, self.T, self.color, state=self.state,
                                   container=self.container)
        return self._message

    @property
    def container_taken(self) -> str:
        """Container that holds it or will hold it, or an empty string."""
        return self.container if self.rest is None else self.rest.container

    @property
    def slot_in(self) -> Slot | None:
        """Slot that it occupies or will occupy."""
        return self.slot if self.rest is None else self.rest.slot

    def block(self) -> Block:
        """Vertical extrusion that obstructs and supports other bodies."""
        T = self.rest_pose
        low, high = (float(T[2, 3]) + end for end in (self.solid.lowest(T[:3, :3]), self.solid.highest(T[:3, :3])))
        outline = self.solid.footprint(T[:3, :3]) + T[:2, 3]
        return Block(self.name, outline, low, high, flat=self.solid.shape != "sphere")

    def snapshot(self) -> ObjectSnapshot:
        """Complete state, for `restored`."""
        if self._snapshot is None:
            rest = self.rest
            self._snapshot = ObjectSnapshot(
                pose=_numbers(self.T), like=self.like,
                definition=self.message() if self.added and not self.like else None,
                details={
                    "state": self.state, "container": self.container, "slot": self.slot, "dropped": self.drop_height,
                    "since": self.drop_time, "width": self.width, "added": self.added, "mass": self.mass,
                    "grip": None if self.grip is None else _numbers(self.grip),
                    "rest": None if rest is None else [_numbers(rest.T), rest.state, rest.container, rest.slot],
                    **({"holder": self.holder, "second": self.second} if self.holder or self.second else {}),
                },
            )
        return self._snapshot


@dataclass(frozen=True, eq=False)
class Block:
    """Vertical extrusion of an outline (N, 2) [m] between two heights [m]; obstructs and may support bodies."""

    id: str
    outline: Array
    low: float
    high: float
    flat: bool  # its top supports bodies

    @cached_property
    def parts(self) -> Array:
        """Convex parts of the outline (n, K, 2) [m]."""
        return convex_parts(self.outline)

    def reaches(self, outline: Array, parts: Array | None = None) -> bool:
        """Whether it overlaps an area seen from above; `parts` are convex parts (m, N, 2) [m] of the area, if known."""
        return not boxes_disjoint(outline, self.outline) and parts_meet(
            convex_parts(outline) if parts is None else parts, self.parts)


class WorldEvents:
    """Collects objects removed and come to rest.

    Attributes:
        version: increases with every change worth publishing.
    """

    def __init__(self) -> None:
        """Start without events."""
        self.version = 0
        self._events: list[SceneUpdate] = []

    def take_events(self) -> list[SceneUpdate]:
        """Return objects removed or come to rest since the last call, in order."""
        events, self._events = self._events, []
        return events

    def _add_event(self, what: Literal["add", "remove"], body: Body) -> None:
        pose = None
        if what == "add":
            x, y, z = (float(v) for v in body.T[:3, 3])
            pose = Pose(position=Vector3(x=x, y=y, z=z)) if body.solid.shape == "sphere" else matrix_to_pose(body.T)
        self._events.append(SceneUpdate(data=f"{what}:{body.name}", pose=pose))
        self.version += 1


def restored(name: str, snapshot: ObjectSnapshot, solid: Solid, color: tuple[float, float, float]) -> Body:
    """Restore a body from its snapshot."""
    d: dict[str, Any] = snapshot.details
    body = Body(
        name, solid, color, _matrix(snapshot.pose), d["state"], d["container"], _slot(d["slot"]),
        None if d["grip"] is None else _matrix(d["grip"]), d["width"], d["dropped"], d["since"],
        added=d["added"], like=snapshot.like, mass=d.get("mass", 0.0),
        holder=d.get("holder", ""), second=d.get("second", ""),
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


TOUCH = 1e-6  # [m]
LINES = 5  # sampled across a finger pad to find the object between the fingers


def pressed_ends(
    allowed: GraspTolerances, body: Body, T_world_tcp: Array, width: float, before: tuple[float, float] | None,
) -> tuple[float, float] | None:
    """Ends along tool y [m] of the part of a body between the pads; None if it is not between them.

    A body that was clear of both fingers stays between them: the closing finger pushes it to the center.

    Args:
        allowed: grasp tolerances.
        body: the candidate.
        T_world_tcp: (4, 4) of a tool whose fingers close along its y axis.
        width: between the fingers [m].
        before: ends in the previous cycle; None if it was not between them.
    """
    solid = body.solid
    reach = allowed.across + allowed.along + max(width / 2, solid.reach) + solid.reach
    if abs(body.T[2, 3] - T_world_tcp[2, 3]) > reach:
        return None
    offset = body.T[:3, 3] - T_world_tcp[:3, 3]
    if math.hypot(*offset.tolist()) > reach:
        return None
    if solid.shape == "sphere":
        x, y, z = T_world_tcp[:3, :3].T @ offset
        if abs(x) > allowed.across or abs(z) > allowed.along:
            return None
        low, high, half = float(y - solid.radius), float(y + solid.radius), solid.radius
        fits, near = abs(y) <= width / 2 - half + allowed.sideways, abs(y) < max(width / 2, half)
    else:
        ends = _pressed(solid, invert(T_world_tcp) @ body.T, width, allowed)
        if ends is None:
            return None
        # The closing finger may cover an end by pushing it.
        low, high = ends if before is None or ends[1] - ends[0] >= before[1] - before[0] else before
        half = (high - low) / 2
        fits = low >= -width / 2 - allowed.sideways and high <= width / 2 + allowed.sideways
        near = abs(low + high) / 2 < max(width / 2, half)
    enters = width / 2 >= half and fits
    return (low, high) if enters or (before is not None and near) else None


def _pressed(
    solid: Solid, T_tcp_object: Array, width: float, allowed: GraspTolerances
) -> tuple[float, float] | None:
    """Ends along tool y [m] of a solid between the pads; None if the line between their centers misses it."""
    if not solid.may_meet(T_tcp_object):
        return None
    x, z = (np.linspace(-half, half, LINES) for half in (allowed.across, allowed.along))
    lines = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    spans = solid.spans(T_tcp_object, lines)
    center = spans[len(lines) // 2]
    if not (np.abs(center).min(axis=1) < width / 2).any() and not ((center[:, 0] < 0) & (center[:, 1] > 0)).any():
        return None
    parts = sorted(tuple(span) for found in spans for span in found.tolist())
    merged: list[list[float]] = []
    for low, high in parts:
        if merged and low <= merged[-1][1] + 1e-4:
            merged[-1][1] = max(merged[-1][1], high)
        else:
            merged.append([low, high])
    inside = [part for part in merged if part[0] <= width / 2 + TOUCH and part[1] >= -width / 2 - TOUCH]
    return (inside[0][0], inside[-1][1]) if inside else None
