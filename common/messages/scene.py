"""The planning scene: what motion avoids."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from common.messages.basics import Header, Label, Message, Name, Positive
from common.messages.geometry import Color, Corners, Pose

Pairs = Annotated[list[tuple[Label, Label]], Field(max_length=2000)]


class CollisionObject(Message):
    """A solid in the planning scene.

    `dimensions` [m]: box (x, y, z), sphere (radius,), cylinder (radius, length along z), prism (length along z). A
    prism has the convex hull of `outline` [m] as its cross-section and, as all shapes, its pose at half its length.
    """

    later: ClassVar[tuple[str, ...]] = ("grip_effort", "mass", "kind")

    id: Name
    role: Literal["fixture", "container", "target", "contained", "attached"]
    shape: Literal["box", "sphere", "cylinder", "prism"]
    dimensions: list[Positive] = Field(min_length=1, max_length=3)
    outline: Corners = Field([], description="cross-section of a prism [m], in its own frame")
    pose: Pose
    color: Color = Color()
    grip_effort: Annotated[float, Field(ge=0, le=1e4)] = Field(
        0.0, description="force that it is to be gripped with [N]; 0: the gripper's own default"
    )
    mass: Annotated[float, Field(ge=0, le=1000)] = Field(0.0, description="[kg]; 0: not known")
    kind: Label = Field("", description="what it is, as the detector that saw it calls it; empty: not known")

    @model_validator(mode="after")
    def _dimensions_fit_shape(self) -> CollisionObject:
        wanted = {"box": 3, "sphere": 1, "cylinder": 2, "prism": 1}[self.shape]
        if (self.shape == "prism") != (len(self.outline) >= 3):
            raise ValueError(f"a {self.shape} has {len(self.outline)} points of an outline")
        if len(self.dimensions) != wanted:
            raise ValueError(f"a {self.shape} has {wanted} dimensions, not {len(self.dimensions)}")
        return self


class AttachedObject(Message):
    """A solid that moves with the robot: `object.pose` is its pose in the frame of `link`."""

    link: Name
    object: CollisionObject


class PlanningScene(Message):
    """What the planner avoids, all of it perceived or fixed; poses of `objects` are in `header.frame_id`."""

    most_bytes: ClassVar[int] = 256 * 1024
    most_parts: ClassVar[int] = 8 * 1024

    header: Header
    objects: list[CollisionObject] = Field([], max_length=500)
    attached: list[AttachedObject] = Field([], max_length=50)
    allowed_collisions: Pairs = Field([], description="pairs of link or object names that may touch")
