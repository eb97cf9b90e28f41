"""The simulated world: its truth and changes of it."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from common.messages.basics import SMALL_BYTES, Finite, Header, Label, Message, Metres, Name, Positive
from common.messages.geometry import Color, Corners, Pose, Vector3

Shape = Literal["sphere", "box", "cylinder", "prism", "ring", "mesh"]


class SceneUpdate(Message):
    """What happened to an object of the simulated world, as in the seed: "remove:ID", "add:ID"."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    data: Label
    pose: Pose | None = None


class WorldEdit(Message):
    """Change the simulated world. `reset` brings the first layout back, `drop` lets what is held slip.

    `id` may be empty for `add` and `drop`. What is added is like the object that `like` names, or like the first of the
    world, but for what is said here.
    """

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES
    max_parts: ClassVar[int] = 2048 + 8

    op: Literal["add", "move", "remove", "reset", "drop"]
    id: Label = ""
    position: Vector3 | None = Field(None, description="centre [m]; z is found from what lies there")
    yaw: Finite | None = Field(None, description="of what is added or moved [rad]")
    like: Label = Field("", description="id of an object of the world's first layout: add one more of those")
    shape: Literal["sphere", "box", "cylinder", "prism", "ring"] | None = None
    size: Vector3 | None = Field(None, description="of the box about it [m]; of a sphere or what is round, x counts")
    inner_radius: Positive | None = Field(None, description="of a ring [m]")
    polygon: Corners = Field([], description="cross-section of a prism [m]; its height is z of size")
    color: Color | None = None
    mass: Positive | None = Field(None, description="[kg]")


class WorldEditReply(Message):
    """The object that was changed and what is in the world now."""

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES
    max_parts: ClassVar[int] = 512

    id: Label
    ids: list[Label] = Field(max_length=1000)


class WorldObject(Message):
    """A solid of the simulated world as it is now.

    `pose` is that of its own frame: at half its height; on the axis of a sphere, cylinder or ring; in the middle of a
    box; where the polygon of a prism has its origin; for a mesh that of its file. Of a recording from before objects
    had poses, the pose is made of the outline.

    What stands upright also has its outer edge in world as `outline`, anticlockwise, its inner edge, if it has one, as
    `hole`, and where it stands. Spheres, meshes and what is moved have none.
    """

    id: Name
    shape: Shape
    pose: Pose = Pose()
    size: Vector3 = Field(Vector3(), description="of the box about it, along the axes of its own frame [m]")
    inner_radius: Annotated[float, Field(ge=0, le=1e7)] = Field(0.0, description="of a ring [m]")
    polygon: Corners = Field([], description="cross-section of a prism, anticlockwise [m], in its own frame")
    vertices: list[tuple[Metres, Metres, Metres]] = Field(
        [], max_length=40_000, description="of a mesh [m], in its own frame"
    )
    triangles: list[tuple[int, int, int]] = Field([], max_length=80_000, description="of a mesh: indices of vertices")
    color: Color = Color()
    state: Literal["table", "held", "falling", "contained", "elsewhere"] = Field(
        "table", description="lies on something, in the hand, falls, lies in a container, or is out of sight"
    )
    container: Label = Field("", description="id of the container in which it lies")
    outline: Corners = Field([], description="of what stands upright [m], world")
    hole: Corners = Field([], description="of what stands upright and has one [m], world")
    base: Metres = Field(0.0, description="z on which it stands [m]")
    height: Annotated[float, Field(ge=0, le=1e7)] = Field(0.0, description="of what stands upright [m]")

    @model_validator(mode="before")
    @classmethod
    def _pose_of_an_outline(cls, values: Any) -> Any:
        """Recordings from before have outlines alone."""
        if not isinstance(values, dict) or "pose" in values or not values.get("outline"):
            return values
        return {**values, **_from_outline(values)}

    @model_validator(mode="after")
    def _has_a_shape(self) -> WorldObject:
        if self.shape == "mesh":
            count = len(self.vertices)
            if not self.triangles:
                raise ValueError("a mesh has triangles")
            if any(not 0 <= corner < count for triangle in self.triangles for corner in triangle):
                raise ValueError(f"triangles are of vertices 0 to {count - 1}")
        if self.shape == "prism" and len(self.polygon) < 3:
            raise ValueError("the polygon of a prism has at least 3 corners")
        return self


class WorldObjects(Message):
    """All solids of the simulated world: the truth."""

    max_bytes: ClassVar[int] = 4 * 1024 * 1024  # meshes
    max_parts: ClassVar[int] = 128 * 1024

    header: Header = Header()
    objects: list[WorldObject] = Field([], max_length=1000)


def _from_outline(values: dict[str, Any]) -> dict[str, Any]:
    """Pose, size and cross-section of a solid of which only outline, hole, base and height are known."""
    outline, hole = values["outline"], values.get("hole") or []
    try:
        xs, ys = zip(*[(float(x), float(y)) for x, y in outline], strict=True)
        base, height = float(values.get("base", 0.0)), float(values.get("height", 0.0))
        x, y = (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2
        across, along, yaw = max(xs) - min(xs), max(ys) - min(ys), 0.0
        if values.get("shape") == "box" and len(outline) == 4:
            across, along = math.dist(outline[0], outline[1]), math.dist(outline[1], outline[2])
            yaw = math.atan2(ys[1] - ys[0], xs[1] - xs[0])
        inner = (max(a for a, _ in hole) - min(a for a, _ in hole)) / 2 if hole else 0.0
    except (TypeError, ValueError, LookupError):
        return {}  # whatever is wrong with them is told by their own fields
    found: dict[str, Any] = {
        "pose": {"position": {"x": x, "y": y, "z": base + height / 2},
                 "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}},
        "size": {"x": across, "y": along, "z": height}, "inner_radius": inner,
    }
    if values.get("shape") == "prism":
        found["polygon"] = [(a - x, b - y) for a, b in zip(xs, ys, strict=True)]
    return found
