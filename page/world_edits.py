"""Edits of the simulated world, with what takes each of them back."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from common.errors import RemoteError, ZencellError
from common.messages import Vector3, WorldEdit, WorldEditReply, WorldObject, WorldObjects
from common.robot.transforms import matrix_to_rpy, pose_to_matrix

MOST = 50  # edits that can be taken back
_LIES = ("table", "contained")
_MOVED = 1e-4  # [m]
_APART = 1.3  # of the size of what is added: to the middle of what lies there already
TRIED = 15  # free places: some are off the table
_RINGS, _TURNS = 6, 12  # places that are looked at for one that is free


class NothingToUndo(ZencellError):
    """No edit was made, or all are taken back."""


class NoRoom(ZencellError):
    """There is no free place."""


@dataclass(frozen=True)
class _Done:
    told: str
    back: tuple[WorldEdit, ...]


class WorldEdits:
    """Does edits and takes back the last one, again and again."""

    def __init__(
        self, ask: Callable[[WorldEdit], Awaitable[WorldEditReply]], truth: Callable[[], WorldObjects | None]
    ) -> None:
        """Begin without any.

        Args:
            ask: has the world edited.
            truth: what is in it now.
        """
        self._ask, self._truth = ask, truth
        self._done: list[_Done] = []

    @property
    def last(self) -> str:
        """What would be taken back; empty for nothing."""
        return self._done[-1].told if self._done else ""

    async def do(self, edit: WorldEdit) -> str:
        """Edit the world; returns what was done, in words.

        Raises:
            RequestFailed: it was not.
        """
        told = self._truth()
        before = {thing.id: thing for thing in told.objects} if told is not None else {}
        reply = await self._ask(edit)
        words = f"{edit.op} {reply.id or 'of the world'}"
        self._done.append(_Done(words, tuple(undoing(edit, before, reply))))
        del self._done[:-MOST]
        return words

    async def undo(self) -> str:
        """Take back the last edit; returns which it was.

        Raises:
            NothingToUndo: there is none.
            RequestFailed: it cannot be taken back any more; it is forgotten.
        """
        if not self._done:
            raise NothingToUndo("there is no edit to take back")
        done = self._done.pop()
        waiting = list(done.back)
        while waiting:
            taken: list[WorldEdit] = []  # places on which something else still lies, which may have its turn later
            for edit in waiting:
                try:
                    await self._restore(edit)
                except RemoteError as error:
                    if error.code != "occupied":
                        raise
                    taken.append(edit)
                    refused = error
            if len(taken) == len(waiting):
                raise refused
            waiting = taken
        return done.told

    async def add_like(self, thing: WorldObject, x: float, y: float) -> str:
        """Add another object like one, near a place [m] where nothing lies; returns what was done, in words.

        Raises:
            RequestFailed: it was not.
        """
        model, refused = WorldEdit(op="add", like=thing.id), None
        for at in free_places(x, y, max(thing.size.x, thing.size.y), self._truth())[:TRIED]:
            try:
                return await self.do(model.model_copy(update={"position": Vector3(x=at[0], y=at[1])}))
            except RemoteError as error:
                if error.code == "unknown_id" and model.like and thing.shape != "mesh":
                    model = added_again(thing).model_copy(update={"id": ""})
                    return await self.do(model.model_copy(update={"position": Vector3(x=at[0], y=at[1])}))
                refused = refused or error
        raise refused or NoRoom(f"nothing is free near {1e3 * x:.0f}, {1e3 * y:.0f} mm")

    async def _restore(self, edit: WorldEdit) -> None:
        """Do an edit that takes one back: what was removed comes back as the first layout has it, if that has it."""
        if edit.op != "add":
            await self._ask(edit)
            return
        try:
            await self._ask(WorldEdit(op="add", id=edit.id, like=edit.id, position=edit.position, yaw=edit.yaw))
        except RemoteError as error:
            if error.code != "unknown_id" or edit.shape is None:
                raise
            await self._ask(edit)


def undoing(edit: WorldEdit, before: dict[str, WorldObject], reply: WorldEditReply) -> list[WorldEdit]:
    """The edits that take one back.

    Args:
        edit: that was done.
        before: what was in the world, by id.
        reply: to the edit.
    """
    if edit.op == "add":
        return [WorldEdit(op="remove", id=reply.id)]
    if edit.op == "move" and reply.id in before:
        return [moved_back(before[reply.id])]
    if edit.op == "remove" and reply.id in before:
        return [added_again(before[reply.id])]
    if edit.op == "reset":
        extra = [WorldEdit(op="remove", id=name) for name in reply.ids if name not in before]
        lay = [thing for thing in before.values() if thing.state in _LIES]
        return extra + [moved_back(thing) if thing.id in reply.ids else added_again(thing) for thing in lay]
    return []


def middle_of(thing: WorldObject) -> Vector3:
    """Where an edit would say that an object is [m]."""
    from common.sim.objects import centre_of

    x, y, z = centre_of(thing)
    return Vector3(x=float(x), y=float(y), z=float(z))


def moved_back(thing: WorldObject) -> WorldEdit:
    """What brings an object to where it is now."""
    return WorldEdit(op="move", id=thing.id, position=middle_of(thing), yaw=_yaw(thing))


def added_again(thing: WorldObject) -> WorldEdit:
    """What brings an object into the world that is like one."""
    shape = thing.shape if thing.shape != "mesh" else None
    return WorldEdit.model_validate({
        "op": "add", "id": thing.id, "position": middle_of(thing), "yaw": _yaw(thing), "shape": shape,
        "size": thing.size, "inner_radius": thing.inner_radius or None, "color": thing.color,
        "polygon": thing.polygon if shape == "prism" else []})


def free_places(x: float, y: float, size: float, truth: WorldObjects | None) -> list[tuple[float, float]]:
    """Places for something of a size [m] where nothing lies, nearest to x, y [m] first."""
    taken = [middle_of(thing) for thing in truth.objects if thing.state in _LIES] if truth is not None else []

    def free(at: tuple[float, float]) -> bool:
        return all(math.hypot(at[0] - other.x, at[1] - other.y) >= _APART * size for other in taken)

    places = [(x, y)] + [(x + ring * _APART * size * math.cos(turn * 2 * math.pi / _TURNS),
                          y + ring * _APART * size * math.sin(turn * 2 * math.pi / _TURNS))
                         for ring in range(1, _RINGS + 1) for turn in range(_TURNS)]
    return [place for place in places if free(place)]


def _yaw(thing: WorldObject) -> float | None:
    """Its turn about z [rad]; None for what is round."""
    return None if thing.shape == "sphere" else matrix_to_rpy(pose_to_matrix(thing.pose)[:3, :3])[2]
