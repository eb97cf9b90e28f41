"""Solids that a person says are there: nobody perceives them, and they stay until a person takes them away."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from common.errors import Refused
from common.messages import CollisionObject, SceneEdit
from common.messages.scene import MAX_ADDED

PREFIX = "added/"  # of their ids in the planning scene


class AddedSolids(BaseModel):
    """All of them, as they outlive the process that keeps the scene."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    solids: list[CollisionObject] = Field([], max_length=MAX_ADDED)

    @property
    def ids(self) -> list[str]:
        """Their ids in the planning scene."""
        return [solid.id for solid in self.solids]

    def edited(self, edit: SceneEdit, perceived: Iterable[str] = ()) -> AddedSolids:
        """What there is after an edit: the same said again changes nothing.

        Args:
            edit: a checked one.
            perceived: ids of all else in the planning scene.

        Raises:
            Refused: `exists`, `unknown` or `too_many`.
        """
        name = id_of(edit.id)
        before = next((solid for solid in self.solids if solid.id == name), None)
        others = [solid for solid in self.solids if solid is not before]
        if edit.op == "remove":
            if before is None:
                raise Refused("unknown", f"nothing was added as {name}; there are: {', '.join(self.ids) or 'none'}")
            return AddedSolids(solids=others)
        solid = CollisionObject.model_validate({
            "id": name, "role": "fixture", "shape": edit.shape, "dimensions": edit.dimensions, "pose": edit.pose,
            "color": edit.color})
        if solid == before:
            return self
        if before is not None or name in perceived:
            raise Refused("exists", f"{name} is there already, and is another solid: remove it first")
        if len(others) >= MAX_ADDED:
            raise Refused("too_many", f"{MAX_ADDED} solids were added already: remove some first")
        return AddedSolids(solids=[*others, solid])


def id_of(name: str) -> str:
    """The id in the planning scene of what a person calls so."""
    return name if name.startswith(PREFIX) else PREFIX + name


def added(objects: Iterable[CollisionObject]) -> list[CollisionObject]:
    """Those of the objects of a planning scene that a person added."""
    return [thing for thing in objects if thing.id.startswith(PREFIX)]
