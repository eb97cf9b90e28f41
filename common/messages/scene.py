"""The planning scene: what motion avoids."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from common.messages.basics import SMALL_BYTES, Header, Label, Message, Name, Positive
from common.messages.geometry import Color, Corners, Pose

Pairs = Annotated[list[tuple[Label, Label]], Field(max_length=2000)]


Side = Annotated[float, Field(ge=0.001, le=10)]  # [m] of what a person says is there
FARTHEST = 10.0  # [m] along each axis from the origin of world, of what a person says is there
MAX_ADDED = 50
_DIMENSIONS = {"box": 3, "sphere": 1, "cylinder": 2, "prism": 1}


def _require_dimensions(shape: str, dimensions: list[float]) -> None:
    if len(dimensions) != _DIMENSIONS[shape]:
        raise ValueError(f"a {shape} has {_DIMENSIONS[shape]} dimensions, not {len(dimensions)}")


class CollisionObject(Message):
    """A solid in the planning scene.

    `dimensions` [m]: box (x, y, z), sphere (radius,), cylinder (radius, length along z), prism (length along z). A
    prism has the convex hull of `outline` [m] as its cross-section and, as all shapes, its pose at half its length.
    """

    omitted_defaults: ClassVar[tuple[str, ...]] = ("grip_effort", "mass", "kind", "unseen")

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
    unseen: bool = Field(False, description="taken to be there by what is seen: something has to carry that")

    @model_validator(mode="after")
    def _dimensions_fit_shape(self) -> CollisionObject:
        if (self.shape == "prism") != (len(self.outline) >= 3):
            raise ValueError(f"a {self.shape} has {len(self.outline)} points of an outline")
        _require_dimensions(self.shape, self.dimensions)
        return self


class AttachedObject(Message):
    """A solid that moves with the robot: `object.pose` is its pose in the frame of `link`."""

    link: Name
    object: CollisionObject


class PlanningScene(Message):
    """What the planner avoids, all of it perceived or fixed; poses of `objects` are in `header.frame_id`."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024

    header: Header
    objects: list[CollisionObject] = Field([], max_length=500)
    attached: list[AttachedObject] = Field([], max_length=50)
    allowed_collisions: Pairs = Field([], description="pairs of link or object names that may touch")


class SceneEdit(Message):
    """Add a solid that nobody perceives to the planning scene, or remove one that was added.

    `id` is a name of one's own: in the scene it stands as `added/NAME`, which nothing else is called.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    op: Literal["add", "remove"]
    id: Annotated[Name, Field(max_length=100)]
    shape: Literal["box", "sphere", "cylinder"] | None = None
    dimensions: list[Side] = Field([], max_length=3, description="as of a CollisionObject [m]")
    pose: Pose | None = Field(None, description="in world, at most 10 m from its origin along each axis")
    color: Color = Color(r=0.9, g=0.6, b=0.1, a=0.8)
    owner: Label = Field("", description="who says so")

    @model_validator(mode="after")
    def _says_what_is_added(self) -> SceneEdit:
        if self.op == "remove":
            return self
        if self.shape is None:
            raise ValueError("what is added has a shape: box, sphere or cylinder")
        _require_dimensions(self.shape, self.dimensions)
        if self.pose is None:
            raise ValueError("what is added has a pose")
        at = self.pose.position
        for axis, value in (("x", at.x), ("y", at.y), ("z", at.z)):
            if abs(value) > FARTHEST:
                raise ValueError(f"pose.position.{axis} {value:g} is farther than {FARTHEST:g} m from the origin")
        return self


class SceneEditReply(Message):
    """The id of the solid in the planning scene, and those of all that were added."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    id: Name
    ids: list[Name] = Field(max_length=MAX_ADDED)
