"""A depth image as a cloud of coloured points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.messages import Header, PointCloud2
from common.perception.pinhole import Pinhole


def point_cloud(
    picture: npt.NDArray[np.uint8], depth: npt.NDArray[np.float32], camera: Pinhole, header: Header
) -> PointCloud2:
    """Points of all pixels in the optical frame, row by row, NaN where there is no depth.

    `rgb` is 0x00rrggbb in the bits of a float32, as point clouds have it in ROS.
    """
    height, width = depth.shape
    cloud = np.empty((height, width, 4), "<f4")
    cloud[..., 0] = depth * ((np.arange(width) - camera.cx) / camera.fx).astype(np.float32)[None, :]
    cloud[..., 1] = depth * ((np.arange(height) - camera.cy) / camera.fy).astype(np.float32)[:, None]
    cloud[..., 2] = depth
    blue, green, red = (picture[..., i].astype(np.uint32) for i in range(3))
    cloud[..., 3] = (red << 16 | green << 8 | blue).astype("<u4").view("<f4")
    return PointCloud2(header=header, height=height, width=width, row_step=16 * width, data=cloud.tobytes())
