"""Points, poses, transforms and colours."""

from __future__ import annotations

import math

from pydantic import Field, model_validator

from common.messages.basics import Finite, Fraction, Header, Message, Name


class Vector3(Message):
    """A point, displacement [m] or box size [m]."""

    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0


class Quaternion(Message):
    """A unit quaternion; refused when its norm is more than 1e-3 off one."""

    x: Finite = 0.0
    y: Finite = 0.0
    z: Finite = 0.0
    w: Finite = 1.0

    @model_validator(mode="after")
    def _is_unit(self) -> Quaternion:
        norm = math.sqrt(self.x**2 + self.y**2 + self.z**2 + self.w**2)
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"quaternion has norm {norm:.4f}, not 1")
        return self


class Pose(Message):
    """Position [m] and orientation."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class PoseArray(Message):
    """Poses of several things; `ids[i]` and `labels[i]`, where given, belong to `poses[i]`."""

    header: Header = Header()
    poses: list[Pose] = []
    ids: list[str] = []
    labels: list[str] = Field([], description="of truth: table, held, falling, box, or elsewhere (out of sight)")

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

    transforms: list[TransformStamped]


class Color(Message):
    """Red, green, blue and opacity, each 0 to 1."""

    r: Fraction = 1.0
    g: Fraction = 1.0
    b: Fraction = 1.0
    a: Fraction = 1.0
