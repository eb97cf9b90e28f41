"""The planning scene and the simulated world of a cell, as a program edits them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from common import topics
from common.client.arguments import given
from common.client.goals import Point, array_of, numbers, pose_of
from common.client.subscriptions import Part, Subscriptions
from common.config import check
from common.messages import CollisionObject, Pose, SceneEdit, SceneEditReply, WorldEdit, WorldObject
from common.scene.fixtures import added_solids
from common.transport.bus import Bus

TIMEOUT = 5.0  # [s] wall for an answer


class Scene(Part):
    """Solids that an operator adds to the planning scene because no camera sees them; they stay until removed."""

    def __init__(self, subscriptions: Subscriptions, owner: str) -> None:
        """The planning scene of a cell, edited by the client `owner`."""
        self._subscriptions, self._owner = subscriptions, owner

    async def add(
        self, name: str, shape: Literal["box", "sphere", "cylinder"], dimensions: Sequence[float],
        at: Pose | Point, *, color: Sequence[float] | None = None,
    ) -> str:
        """Add a solid, and return its id in the planning scene. A motion that would hit it brakes.

        Args:
            name: name of your choice; adding the same solid again changes nothing.
            shape: of the solid.
            dimensions: box (x, y, z), sphere (radius,), cylinder (radius, length along z) [m].
            at: its centre in world [m], or its pose (4, 4).
            color: red, green, blue, 0 to 1 each.

        Raises:
            ConfigError: invalid values.
            RemoteError: `exists`, `too_many`, or `not_kept` if it would be lost at a restart.
        """
        edit: dict[str, object] = {"op": "add", "id": name, "shape": shape, "owner": self._owner,
                                   "dimensions": array_of("dimensions", dimensions).tolist(), "pose": pose_of("at", at)}
        if color is not None:
            edit["color"] = dict(zip("rgb", numbers("color", color).tolist(), strict=True))
        return (await self._edit(edit)).id

    async def remove(self, name: str) -> list[str]:
        """Remove a solid by name, also one that another operator added, and return the ids of the remaining ones.

        Raises:
            RemoteError: `unknown`, with the names that exist.
        """
        return (await self._edit({"op": "remove", "id": name, "owner": self._owner})).ids

    async def objects(self) -> list[CollisionObject]:
        """Return the added solids: ids, shapes, dimensions [m] and poses in world."""
        return added_solids((await self._subscriptions.query(topics.PLANNING_SCENE)).objects)

    async def _edit(self, edit: dict[str, object]) -> SceneEditReply:
        client = self._subscriptions.bus.client(topics.SCENE_EDIT)
        return await client.call(check(SceneEdit, edit, "scene"), TIMEOUT)


class World(Part):
    """The simulated world; a real one cannot be edited."""

    def __init__(self, bus: Bus, subscriptions: Subscriptions) -> None:
        """The world of a cell."""
        self._bus, self._subscriptions = bus, subscriptions

    async def edit(self, op: str, /, **fields: Any) -> list[str]:
        """Edit the world with the fields of a `WorldEdit`, and return the ids of all objects."""
        edit = check(WorldEdit, given({"op": op}, fields, own=()), "world")
        return (await self._bus.client(topics.WORLD_EDIT).call(edit, TIMEOUT)).ids

    async def add(self, x: float, y: float, **more: Any) -> list[str]:
        """Add an object at a position [m]; fields that are not given are those of the first object."""
        return await self.edit("add", **given({"position": {"x": x, "y": y}}, more, own=()))

    async def move(self, name: str, x: float, y: float, **more: Any) -> list[str]:
        """Move an object to another position [m]."""
        return await self.edit("move", **given({"id": name, "position": {"x": x, "y": y}}, more, own=()))

    async def remove(self, name: str) -> list[str]:
        """Remove an object."""
        return await self.edit("remove", id=name)

    async def reset(self) -> list[str]:
        """Restore the first layout."""
        return await self.edit("reset")

    async def objects(self) -> list[WorldObject]:
        """Return the ground truth: the position of every object. Perception must not use it."""
        return (await self._subscriptions.query(topics.SCENE_OBJECTS)).objects
