"""What persons say is there, for a program: solids of the planning scene that nobody perceives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from common import topics
from common.client.goals import Point, array_of, numbers, place
from common.client.part import Part
from common.client.subscriptions import Subscriptions
from common.config import check
from common.messages import CollisionObject, Pose, SceneEdit, SceneEditReply
from common.scene.added_solids import added_solids

TIMEOUT = 5.0  # [s] wall for an answer


class Scene(Part):
    """Solids that motion keeps away from though nobody perceives them; they stay until they are removed."""

    def __init__(self, ear: Subscriptions, owner: str) -> None:
        """The planning scene of a cell, edited in the name of `owner`."""
        self._ear, self._owner = ear, owner

    async def add(
        self, name: str, shape: Literal["box", "sphere", "cylinder"], dimensions: Sequence[float],
        at: Pose | Point, *, color: Sequence[float] | None = None,
    ) -> str:
        """Add a solid, and return its id in the planning scene. What moves into it brakes.

        Args:
            name: of your own; the same said again changes nothing.
            shape: what it is.
            dimensions: box (x, y, z), sphere (radius,), cylinder (radius, length along z) [m].
            at: its middle in world [m], or its pose (4, 4).
            color: red, green, blue, 0 to 1 each.

        Raises:
            ConfigError: what cannot be asked for.
            RemoteError: `exists`, `too_many`, or `not_kept` where it would not outlive a restart.
        """
        asked: dict[str, object] = {"op": "add", "id": name, "shape": shape, "owner": self._owner,
                                    "dimensions": array_of("dimensions", dimensions).tolist(), "pose": place("at", at)}
        if color is not None:
            asked["color"] = dict(zip("rgb", numbers("color", color).tolist(), strict=True))
        return (await self._edit(asked)).id

    async def remove(self, name: str) -> list[str]:
        """Take out what was added under a name, by whomever, and return the ids of what is left.

        Raises:
            RemoteError: `unknown`, with those that there are.
        """
        return (await self._edit({"op": "remove", "id": name, "owner": self._owner})).ids

    async def objects(self) -> list[CollisionObject]:
        """What was added: ids, shapes, dimensions [m] and poses in world."""
        return added_solids((await self._ear.now(topics.PLANNING_SCENE)).objects)

    async def _edit(self, asked: dict[str, object]) -> SceneEditReply:
        return await self._ear.bus.client(topics.SCENE_EDIT).call(check(SceneEdit, asked, "scene"), TIMEOUT)
