"""Depth images: decode messages to [m], convert pixels with depth to world points and point clouds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.errors import ZencellError
from common.messages import Header, Image, PointCloud2
from common.perception.camera_input import FrameError
from common.perception.image import ImageError, image_to_array
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]

MAX_DEPTH = 1e4  # [m]; some cameras report the largest float where they measure nothing


class DepthError(ZencellError):
    """A depth image that cannot locate an object. `kind` names the cause: size, nothing, invalid or far."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def check_depth(depth: npt.NDArray[np.float32], width: int, height: int) -> None:
    """Check that the depth image has the size of the color image and any valid depth.

    Raises:
        DepthError: it does not.
    """
    if depth.ndim != 2 or depth.shape != (height, width):
        shape = "x".join(str(n) for n in depth.shape[::-1])
        raise DepthError("size", f"the depth image is {shape}, but the color image is {width}x{height}")
    if not is_valid(depth).any():
        raise DepthError("nothing", "the depth image has no valid depth at all: nothing is within the camera's range")


def is_valid(depth: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Mask of pixels with a usable depth: positive and below `MAX_DEPTH`."""
    return np.asarray((depth > 0) & (depth < MAX_DEPTH))


@dataclass(frozen=True, eq=False)
class Rays:
    """World rays through pixels, scaled to 1 m of depth: the point at depth d is `origin + d * directions`."""

    origin: Array
    directions: Array

    @classmethod
    def through(cls, camera: Pinhole, pixels: npt.ArrayLike) -> Rays:
        """Return rays (..., 3) through pixels (..., 2)."""
        p = np.asarray(pixels, dtype=float)
        x, y = (p[..., 0] - camera.cx) / camera.fx, (p[..., 1] - camera.cy) / camera.fy
        optical = np.stack([x, y, np.ones_like(x)], axis=-1)
        return cls(camera.position, optical @ camera.T_world_optical[:3, :3].T)

    def at_depth(self, depth: npt.ArrayLike) -> Array:
        """Points (..., 3) [m] at depths (...) [m] along the optical axis."""
        return np.asarray(self.origin + np.asarray(depth, dtype=float)[..., None] * self.directions)

    def at_height(self, z: npt.ArrayLike) -> Array:
        """Points (..., 3) [m] at heights z (...) [m] in world."""
        return self.at_depth((np.asarray(z, dtype=float) - self.origin[2]) / self.directions[..., 2])


def point_cloud(
    colors: npt.NDArray[np.uint8], depth: npt.NDArray[np.float32], camera: Pinhole, header: Header
) -> PointCloud2:
    """Organized point cloud of all pixels in the optical frame, row by row; NaN without depth.

    `rgb` is 0x00rrggbb in the bits of a float32, as in ROS point clouds.
    """
    height, width = depth.shape
    cloud = np.empty((height, width, 4), "<f4")
    cloud[..., 0] = depth * ((np.arange(width) - camera.cx) / camera.fx).astype(np.float32)[None, :]
    cloud[..., 1] = depth * ((np.arange(height) - camera.cy) / camera.fy).astype(np.float32)[:, None]
    cloud[..., 2] = depth
    blue, green, red = (colors[..., i].astype(np.uint32) for i in range(3))
    cloud[..., 3] = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
    return PointCloud2(header=header, height=height, width=width, row_step=16 * width, data=cloud.tobytes())


def depth_of(image: Image) -> Depth:
    """Return the depth image (height, width) [m] of a message; 16UC1 is in millimeters with 0 for none, as in ROS.

    Raises:
        FrameError: the encoding is no depth, or the data are inconsistent.
    """
    if image.encoding not in ("32FC1", "16UC1"):
        raise FrameError("encoding", f"encoding {image.encoding!r} is no depth image; choices: 32FC1, 16UC1")
    try:
        values = image_to_array(image)
    except ImageError as error:
        raise FrameError(error.kind, str(error)) from None
    if image.encoding == "16UC1":
        return np.where(values > 0, values / np.float32(1000), np.float32(np.nan)).astype(np.float32)
    return np.asarray(values, np.float32)
