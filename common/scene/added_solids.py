"""Solids that an operator adds to the planning scene: cameras do not see them, and they stay until they are removed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from common.errors import Refused
from common.messages import CollisionObject, SceneEdit
from common.messages.scene import MAX_ADDED

PREFIX = "added/"  # of their ids in the planning scene


class AddedSolids(BaseModel):
    """All added solids, as persisted across restarts of the service that publishes the scene."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    solids: list[CollisionObject] = Field([], max_length=MAX_ADDED)

    @property
    def ids(self) -> list[str]:
        """Their ids in the planning scene."""
        return [solid.id for solid in self.solids]

    def apply(self, edit: SceneEdit, perceived: Iterable[str] = ()) -> AddedSolids:
        """Return the solids after an edit; repeating an edit changes nothing.

        Args:
            edit: a validated one.
            perceived: ids of all other objects of the planning scene.

        Raises:
            Refused: `exists`, `unknown` or `too_many`.
        """
        name = added_id(edit.id)
        existing = next((solid for solid in self.solids if solid.id == name), None)
        others = [solid for solid in self.solids if solid is not existing]
        if edit.op == "remove":
            if existing is None:
                raise Refused("unknown", f"no added solid is called {name}; there are: {', '.join(self.ids) or 'none'}")
            return AddedSolids(solids=others)
        solid = CollisionObject.model_validate({
            "id": name, "role": "fixture", "shape": edit.shape, "dimensions": edit.dimensions, "pose": edit.pose,
            "color": edit.color})
        if solid == existing:
            return self
        if existing is not None or name in perceived:
            raise Refused("exists", f"another solid is called {name} already: remove it first")
        if len(others) >= MAX_ADDED:
            raise Refused("too_many", f"{MAX_ADDED} solids were added already: remove some first")
        return AddedSolids(solids=[*others, solid])


def added_id(name: str) -> str:
    """Return the id in the planning scene of a solid that an operator named."""
    return name if name.startswith(PREFIX) else PREFIX + name


def added_solids(objects: Iterable[CollisionObject]) -> list[CollisionObject]:
    """Return those objects of a planning scene that an operator added."""
    return [item for item in objects if item.id.startswith(PREFIX)]
