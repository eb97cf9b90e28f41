"""Images, calibrations and detections."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from common.messages.basics import (
    MAX_PAYLOAD_BYTES,
    SMALL_BYTES,
    Color,
    Finite,
    Header,
    Label,
    Message,
    Pose,
    Text,
    Vector3,
)


class Image(Message):
    """Pixels in row-major order. `step` is the row stride [bytes], 0: unpadded. See common/perception/image.py."""

    max_bytes: ClassVar[int] = MAX_PAYLOAD_BYTES
    max_parts: ClassVar[int] = 16

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    encoding: Label = Field(description="bgr8, rgb8, mono8, 16UC1 or 32FC1")
    is_bigendian: bool = False
    step: int = Field(0, ge=0, le=MAX_PAYLOAD_BYTES)
    data: bytes


class CameraInfo(Message):
    """Pinhole calibration, as sensor_msgs/CameraInfo: `k` is the 3x3 intrinsic matrix [px] in row-major order."""

    max_bytes: ClassVar[int] = SMALL_BYTES
    omitted_defaults: ClassVar[tuple[str, ...]] = ("without_robot",)

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    distortion_model: Label = "plumb_bob"
    d: list[Finite] = Field([], max_length=64)
    k: list[Finite] = Field(min_length=9, max_length=9)
    without_robot: bool = Field(False, description="images are rendered without the robot and show what is behind it")

    @model_validator(mode="after")
    def _require_focal_lengths(self) -> CameraInfo:
        if self.k[0] <= 0 or self.k[4] <= 0:
            raise ValueError(f"focal lengths must be positive, not {self.k[0]:g} and {self.k[4]:g}")
        return self


class Marker(Message):
    """A detection, or a shape for the operator. `scale` is the full size [m]."""

    ns: Label
    id: int
    type: Literal["sphere", "cylinder", "box", "text"]
    pose: Pose
    scale: Vector3
    color: Color = Color()
    text: Text = ""
    pixel: tuple[Finite, Finite] | None = Field(None, description="centre in the image, (u, v) [px]")
    partial: bool = Field(False, description="touches the border of the image: partly out of view")


class MarkerArray(Message):
    """Markers of one instant; a later message with the same header frame replaces them all."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("blind",)

    header: Header
    markers: list[Marker] = Field(max_length=1000)
    remark: Text = Field("", description="what was detected and is no marker, and why")
    blind: Text = Field("", description="why the image is unusable; empty if it is usable")


class PointCloud2(Message):
    """Points as rows of little-endian float32 x, y, z and one packed color, as sensor_msgs/PointCloud2."""

    max_bytes: ClassVar[int] = MAX_PAYLOAD_BYTES
    max_parts: ClassVar[int] = 16

    header: Header
    height: int = Field(ge=1, le=16384)
    width: int = Field(ge=1, le=16384)
    fields: list[Label] = Field(["x", "y", "z", "rgb"], max_length=64)
    point_step: int = Field(16, ge=4, le=256, description="bytes of one point")
    row_step: int = Field(ge=4, le=MAX_PAYLOAD_BYTES, description="bytes of one row")
    data: bytes


# Reasons of a `Rejection` that readers treat apart.
INSIDE_CONTAINER = "inside the container"
PARTLY_OUT_OF_VIEW = "partly out of view"


class Rejection(Message):
    """A detected object that is not offered to the task, and the reason."""

    position: Vector3
    reason: Text


class Rejections(Message):
    """New rejections: one is sent once for each position."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024

    header: Header
    rejected: list[Rejection] = Field(max_length=1000)
