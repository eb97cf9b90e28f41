"""Pictures, calibrations and what was found in them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from common.messages.basics import Finite, Header, Message
from common.messages.geometry import Color, Pose, Vector3


class Image(Message):
    """Pixels, row by row. `step` is the row stride in bytes; 0 means unpadded. See common/perception/image.py."""

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    encoding: str = Field(description="bgr8, rgb8, mono8, 16UC1 or 32FC1")
    is_bigendian: bool = False
    step: int = Field(0, ge=0)
    data: bytes


class CameraInfo(Message):
    """Pinhole calibration, as sensor_msgs/CameraInfo: `k` is the 3x3 intrinsic matrix [px], row by row."""

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    distortion_model: str = "plumb_bob"
    d: list[Finite] = []
    k: list[Finite] = Field(min_length=9, max_length=9)

    @model_validator(mode="after")
    def _has_focal_lengths(self) -> CameraInfo:
        if self.k[0] <= 0 or self.k[4] <= 0:
            raise ValueError(f"focal lengths must be positive, not {self.k[0]:g} and {self.k[4]:g}")
        return self


class Marker(Message):
    """Something to look at: a detection or a shape for the operator. `scale` is the full size [m]."""

    ns: str
    id: int
    type: Literal["sphere", "cylinder", "box", "text"]
    pose: Pose
    scale: Vector3
    color: Color = Color()
    text: str = ""
    pixel: tuple[Finite, Finite] | None = Field(None, description="where the centre is seen, (u, v) [px]")
    partial: bool = Field(False, description="touches the border of the picture: not wholly in view")


class MarkerArray(Message):
    """Markers of one instant; a later message with the same header frame replaces them all."""

    header: Header
    markers: list[Marker]


class PointCloud2(Message):
    """Points as rows of little-endian float32 x, y, z and one packed colour, as sensor_msgs/PointCloud2."""

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    fields: list[str] = ["x", "y", "z", "rgb"]
    point_step: int = Field(16, ge=4, le=256, description="bytes of one point")
    row_step: int = Field(ge=4, description="bytes of one row")
    data: bytes


class Rejection(Message):
    """A detected object that is not offered to the task, and why."""

    position: Vector3
    reason: str


class Rejections(Message):
    """Rejections that are new: one is sent once for each place."""

    header: Header
    rejected: list[Rejection]
