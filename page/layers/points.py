"""What a depth camera measures, as points in the scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common import topics
from common.messages import PointCloud2
from common.topics import Topic
from page.layers import Layer
from page.nodes import matrix_wxyz

MOST = 20_000  # points that are shown: a browser without a graphics card draws them several times a second
_SIZE = 0.003  # of a point [m]


class Points(Layer):
    """The newest cloud of each depth camera, thinned, in its colours. It is made and sent only while it is shown."""

    LABEL = "Point cloud"
    ON = False
    TOPICS = (topics.DEPTH_CAMERA_POINTS,)
    PERIOD = 0.5

    def build(self) -> None:
        """Start without any."""
        self.nodes: dict[str, viser.PointCloudHandle] = {}  # by the key of the topic

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show a cloud in place of the last of its camera; one that cannot be read is left out."""
        found = thinned(message)
        if found is None:
            return
        points, colors = found
        T = self.stage.transforms.pose(message.header.frame_id)
        self.nodes[topic.key] = self.scene.add_point_cloud(
            f"{self.root}/{topic.key.replace('/', '_')}", points, colors, point_size=_SIZE, point_shape="square",
            point_shading="flat", precision="float32", position=T[:3, 3], wxyz=matrix_wxyz(T))


def thinned(cloud: PointCloud2, most: int = MOST) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | None:
    """Points (n, 3) [m] in the frame of the cloud and their colours (n, 3) red, green, blue, evenly left out of all.

    None for one whose fields or bytes do not fit together, or that has no point.
    """
    step, row = cloud.point_step, cloud.width * cloud.point_step
    if not {"x", "y", "z"} <= set(cloud.fields) or step % 4 or 4 * len(cloud.fields) > step or cloud.row_step < row:
        return None
    if len(cloud.data) < cloud.row_step * (cloud.height - 1) + row:
        return None
    each = max(1, int(np.ceil(np.sqrt(cloud.width * cloud.height / most))))  # of rows, and of points in them
    rows = np.lib.stride_tricks.as_strided(np.frombuffer(cloud.data, np.uint8), (cloud.height, row),
                                           (cloud.row_step, 1), writeable=False)[::each]
    values = np.ascontiguousarray(rows).view("<f4").reshape(len(rows), cloud.width, step // 4)[:, ::each]
    values = values.reshape(-1, step // 4)
    at = values[:, [cloud.fields.index(name) for name in ("x", "y", "z")]]
    known = np.isfinite(at).all(axis=1)
    if not known.any():
        return None
    colors = np.full((int(known.sum()), 3), 200, np.uint8)
    if "rgb" in cloud.fields:
        packed = np.ascontiguousarray(values[known, cloud.fields.index("rgb")]).view("<u4")
        colors = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1).astype(np.uint8)
    return at[known], colors
