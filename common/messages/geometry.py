"""Points, poses, transforms and colours."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from common.messages.basics import SMALL_BYTES, Fraction, Header, Label, Message, Metres, Name, Text

Unit = Annotated[float, Field(ge=-1.001, le=1.001)]  # part of a quaternion
MOST_POSES = 256
Labels = Annotated[list[Label], Field(max_length=MOST_POSES)]
Corner = tuple[Metres, Metres]  # of what is drawn on a plane [m]
Corners = Annotated[list[Corner], Field(max_length=2000)]


class Vector3(Message):
    """A point, displacement [m] or box size [m]."""

    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0


class Quaternion(Message):
    """A unit quaternion; refused when its norm is more than 1e-3 off one."""

    x: Unit = 0.0
    y: Unit = 0.0
    z: Unit = 0.0
    w: Unit = 1.0

    @model_validator(mode="after")
    def _is_unit(self) -> Quaternion:
        norm = math.hypot(self.x, self.y, self.z, self.w)
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"quaternion has norm {norm:.4f}, not 1")
        return self


class Pose(Message):
    """Position [m] and orientation."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class PoseArray(Message):
    """Poses of several things; `ids[i]` and `labels[i]`, where given, belong to `poses[i]`."""

    max_bytes: ClassVar[int] = 2 * SMALL_BYTES
    max_parts: ClassVar[int] = 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("unseen", "blind")

    header: Header = Header()
    poses: list[Pose] = Field([], max_length=MOST_POSES)
    ids: Labels = []
    labels: Labels = Field([], description="of truth: table, held, falling, box, or elsewhere (out of sight); of what "
                                           "is seen: hidden for what was seen there before something hid it")
    remark: Text = Field("", description="what was seen and is none of the poses, and why")
    unseen: Text = Field("", description="what the picture did not show of where things may lie; empty: nothing")
    blind: bool = Field(False, description="the picture showed nothing at all")

    @model_validator(mode="after")
    def _same_length(self) -> PoseArray:
        for field in ("ids", "labels"):
            count = len(getattr(self, field))
            if count not in (0, len(self.poses)):
                raise ValueError(f"{field} has {count} entries for {len(self.poses)} poses")
        return self


class TransformStamped(Message):
    """Pose of `child_frame_id` in `header.frame_id`."""

    header: Header
    child_frame_id: Name
    transform: Pose


class TFMessage(Message):
    """Transforms of one instant."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024

    transforms: list[TransformStamped] = Field(max_length=1000)


class Color(Message):
    """Red, green, blue and opacity, each 0 to 1."""

    r: Fraction = 1.0
    g: Fraction = 1.0
    b: Fraction = 1.0
    a: Fraction = 1.0
