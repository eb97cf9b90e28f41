"""The simulated world: its truth and changes of it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from common.messages.basics import Finite, Header, Message, Name, Positive
from common.messages.geometry import Color, Pose, Vector3


class SceneUpdate(Message):
    """What happened to an object of the simulated world, as in the seed: "remove:ball_3", "add:ball_3"."""

    header: Header = Header()
    data: str
    pose: Pose | None = None


class WorldEdit(Message):
    """Change the simulated world. `reset` brings the first layout back, `drop` lets what is held slip.

    Balls may be added, moved and removed, other objects be moved. `id` may be empty for `add` and `drop`.
    """

    op: Literal["add", "move", "remove", "reset", "drop"]
    id: str = ""
    position: Vector3 | None = Field(None, description="centre [m]; z is found from what lies there")


class WorldEditReply(Message):
    """The object that was changed and what is in the world now."""

    id: str
    ids: list[str]


class WorldObject(Message):
    """A solid of the simulated world, standing upright: its outline [m] in world and its height.

    `outline` is the outer edge of its top face, anticlockwise; `hole` an inner edge, if it has one.
    """

    id: Name
    shape: Literal["box", "cylinder", "prism", "ring"]
    outline: list[tuple[Finite, Finite]] = Field(min_length=3)
    hole: list[tuple[Finite, Finite]] = []
    base: Finite = Field(description="z on which it stands [m]")
    height: Positive
    color: Color = Color()


class WorldObjects(Message):
    """All solids of the simulated world: the truth."""

    header: Header = Header()
    objects: list[WorldObject] = []
