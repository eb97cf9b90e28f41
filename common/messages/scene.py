"""Messages about objects: the planning scene, which motion avoids, and the simulated world with its ground truth."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from common.messages.basics import (
    MAX_STAMP,
    SMALL_BYTES,
    Color,
    Corners,
    Finite,
    Header,
    Label,
    Message,
    Metres,
    Name,
    Pose,
    Positive,
    Vector3,
)

Pairs = Annotated[list[tuple[Label, Label]], Field(max_length=2000)]
Shape = Literal["sphere", "box", "cylinder", "prism", "ring", "mesh"]
Side = Annotated[float, Field(ge=0.001, le=10)]  # [m] of a solid that an operator adds
MAX_DISTANCE = 10.0  # [m] along each axis from the origin of world, of such a solid
MAX_ADDED = 50
_DIMENSIONS = {"box": 3, "sphere": 1, "cylinder": 2, "prism": 1}


def _require_dimensions(shape: str, dimensions: list[float]) -> None:
    if len(dimensions) != _DIMENSIONS[shape]:
        raise ValueError(f"a {shape} has {_DIMENSIONS[shape]} dimensions, not {len(dimensions)}")


class CollisionObject(Message):
    """A solid in the planning scene.

    `dimensions` [m]: box (x, y, z), sphere (radius,), cylinder (radius, length along z), prism (length along z). The
    cross-section of a prism is the convex hull of `outline` [m]; its pose, like that of all shapes, is at its centre.
    """

    omitted_defaults: ClassVar[tuple[str, ...]] = ("grip_effort", "mass", "kind", "unseen", "velocity")

    id: Name
    role: Literal["fixture", "container", "target", "contained", "attached"]
    shape: Literal["box", "sphere", "cylinder", "prism"]
    dimensions: list[Positive] = Field(min_length=1, max_length=3)
    outline: Corners = Field([], description="cross-section of a prism [m], in its own frame")
    pose: Pose
    color: Color = Color()
    grip_effort: Annotated[float, Field(ge=0, le=1e4)] = Field(
        0.0, description="grip force for it [N]; 0: default of the gripper"
    )
    mass: Annotated[float, Field(ge=0, le=1000)] = Field(0.0, description="[kg]; 0: unknown")
    kind: Label = Field("", description="its class, as named by the detector; empty: unknown")
    unseen: bool = Field(False, description="inferred, not detected: a detected object must rest on it")
    velocity: Vector3 = Field(Vector3(), description="by images and encoders, as of the stamp of the scene [m/s]")

    @property
    def moves(self) -> bool:
        """Whether it has a velocity."""
        return self.velocity != Vector3()

    @model_validator(mode="after")
    def _require_dimensions_of_shape(self) -> CollisionObject:
        if (self.shape == "prism") != (len(self.outline) >= 3):
            raise ValueError(f"a {self.shape} has {len(self.outline)} points of an outline")
        _require_dimensions(self.shape, self.dimensions)
        return self


class AttachedObject(Message):
    """A solid that moves with the robot: `object.pose` is its pose in the frame of `link`."""

    link: Name
    object: CollisionObject


class PlanningScene(Message):
    """All solids that the planner avoids, perceived or fixed; poses of `objects` are in `header.frame_id`."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("settled",)

    header: Header
    settled: Annotated[int, Field(ge=0, le=MAX_STAMP)] | None = Field(
        None, description="stamp of the newest image whose objects are all in the scene: later ones show some that are "
        "not confirmed yet; default: header.stamp")
    objects: list[CollisionObject] = Field([], max_length=500)
    attached: list[AttachedObject] = Field([], max_length=50)
    allowed_collisions: Pairs = Field([], description="pairs of link or object names that may touch")


class SceneEdit(Message):
    """Add a solid that no camera perceives to the planning scene, or remove an added one.

    In the scene its id is `added/NAME`, which no perceived object has.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    op: Literal["add", "remove"]
    id: Annotated[Name, Field(max_length=100)]
    shape: Literal["box", "sphere", "cylinder"] | None = None
    dimensions: list[Side] = Field([], max_length=3, description="as of a CollisionObject [m]")
    pose: Pose | None = Field(None, description="in world, at most 10 m from its origin along each axis")
    color: Color = Color(r=0.9, g=0.6, b=0.1, a=0.8)
    owner: Label = Field("", description="name of the operator")

    @model_validator(mode="after")
    def _require_a_placed_solid(self) -> SceneEdit:
        if self.op == "remove":
            return self
        if self.shape is None:
            raise ValueError("an added solid needs a shape: box, sphere or cylinder")
        _require_dimensions(self.shape, self.dimensions)
        if self.pose is None:
            raise ValueError("an added solid needs a pose")
        at = self.pose.position
        for axis, value in (("x", at.x), ("y", at.y), ("z", at.z)):
            if abs(value) > MAX_DISTANCE:
                raise ValueError(f"pose.position.{axis} {value:g} is farther than {MAX_DISTANCE:g} m from the origin")
        return self


class SceneEditReply(Message):
    """The id of the solid in the planning scene, and those of all added solids."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    id: Name
    ids: list[Name] = Field(max_length=MAX_ADDED)


class SceneUpdate(Message):
    """A change of an object of the simulated world: "remove:ID" or "add:ID"."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    data: Label
    pose: Pose | None = None


class WorldEdit(Message):
    """Change the simulated world. `reset` restores the initial layout, `drop` releases the held object.

    `id` may be empty for `add` and `drop`. An added object copies the one named `like`, or the first of the
    world, except for the fields given here.
    """

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES
    max_parts: ClassVar[int] = 2048 + 8

    op: Literal["add", "move", "remove", "reset", "drop"]
    id: Label = ""
    position: Vector3 | None = Field(None, description="centre [m]; z follows from what is below")
    yaw: Finite | None = Field(None, description="of the added or moved object [rad]")
    like: Label = Field("", description="id of an object of the initial layout: add one more of these")
    shape: Literal["sphere", "box", "cylinder", "prism", "ring"] | None = None
    size: Vector3 | None = Field(None, description="of its bounding box [m]; x for a sphere and round shapes")
    inner_radius: Positive | None = Field(None, description="of a ring [m]")
    polygon: Corners = Field([], description="cross-section of a prism [m]; its height is z of size")
    color: Color | None = None
    mass: Positive | None = Field(None, description="[kg]")


class WorldEditReply(Message):
    """The changed object, and all objects of the world."""

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES
    max_parts: ClassVar[int] = 512

    id: Label
    ids: list[Label] = Field(max_length=1000)


class WorldObject(Message):
    """A solid of the simulated world in its current state.

    `pose` is that of its own frame: at half its height; on the axis of a sphere, cylinder or ring; at the centre of a
    box; at the origin of a prism's polygon; the frame of the file of a mesh. In a recording from before objects had
    poses, the pose is derived from the outline.

    An upright solid also has its outer edge in world as `outline`, counterclockwise, its inner edge, if any, as `hole`,
    and the height of its base. Spheres, meshes and moving solids have none.
    """

    id: Name
    shape: Shape
    pose: Pose = Pose()
    size: Vector3 = Field(Vector3(), description="of its bounding box, along the axes of its own frame [m]")
    inner_radius: Annotated[float, Field(ge=0, le=1e7)] = Field(0.0, description="of a ring [m]")
    polygon: Corners = Field([], description="cross-section of a prism, counterclockwise [m], in its own frame")
    vertices: list[tuple[Metres, Metres, Metres]] = Field(
        [], max_length=40_000, description="of a mesh [m], in its own frame"
    )
    triangles: list[tuple[int, int, int]] = Field([], max_length=80_000, description="of a mesh: indices of vertices")
    color: Color = Color()
    state: Literal["table", "held", "falling", "contained", "elsewhere"] = Field(
        "table", description="on the table or another object, in the gripper, falling, in a container, or out of view"
    )
    container: Label = Field("", description="id of the container that it is in")
    outline: Corners = Field([], description="of an upright solid [m], world")
    hole: Corners = Field([], description="of an upright solid with one [m], world")
    base: Metres = Field(0.0, description="z of its base [m]")
    height: Annotated[float, Field(ge=0, le=1e7)] = Field(0.0, description="of an upright solid [m]")

    @model_validator(mode="before")
    @classmethod
    def _pose_of_an_outline(cls, values: Any) -> Any:
        """Derive the pose in old recordings, which have outlines only."""
        if not isinstance(values, dict) or "pose" in values or not values.get("outline"):
            return values
        return {**values, **_from_outline(values)}

    @model_validator(mode="after")
    def _require_a_shape(self) -> WorldObject:
        if self.shape == "mesh":
            count = len(self.vertices)
            if not self.triangles:
                raise ValueError("a mesh needs triangles")
            if any(not 0 <= corner < count for triangle in self.triangles for corner in triangle):
                raise ValueError(f"triangles must index vertices 0 to {count - 1}")
        if self.shape == "prism" and len(self.polygon) < 3:
            raise ValueError("the polygon of a prism needs at least 3 corners")
        return self


class WorldObjects(Message):
    """All solids of the simulated world: the ground truth."""

    max_bytes: ClassVar[int] = 4 * 1024 * 1024  # meshes
    max_parts: ClassVar[int] = 128 * 1024

    header: Header = Header()
    objects: list[WorldObject] = Field([], max_length=1000)


def _from_outline(values: dict[str, Any]) -> dict[str, Any]:
    """Return pose, size and cross-section of a solid from its outline, hole, base and height."""
    outline, hole = values["outline"], values.get("hole") or []
    try:
        xs, ys = zip(*[(float(x), float(y)) for x, y in outline], strict=True)
        base, height = float(values.get("base", 0.0)), float(values.get("height", 0.0))
        x, y = (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2
        size_x, size_y, yaw = max(xs) - min(xs), max(ys) - min(ys), 0.0
        if values.get("shape") == "box" and len(outline) == 4:
            size_x, size_y = math.dist(outline[0], outline[1]), math.dist(outline[1], outline[2])
            yaw = math.atan2(ys[1] - ys[0], xs[1] - xs[0])
        inner = (max(a for a, _ in hole) - min(a for a, _ in hole)) / 2 if hole else 0.0
    except (TypeError, ValueError, LookupError):
        return {}  # the validators of the fields report what is wrong
    found: dict[str, Any] = {
        "pose": {"position": {"x": x, "y": y, "z": base + height / 2},
                 "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}},
        "size": {"x": size_x, "y": size_y, "z": height}, "inner_radius": inner,
    }
    if values.get("shape") == "prism":
        found["polygon"] = [(a - x, b - y) for a, b in zip(xs, ys, strict=True)]
    return found
