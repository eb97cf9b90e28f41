"""Where a camera is: the newest transforms, followed from its frame up to world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.config import CameraConfig
from common.messages import TFMessage, TransformStamped
from common.robot.transforms import pose_to_matrix, rpy_to_matrix, transform

Array = NDArray[np.float64]


class Transforms:
    """The newest transform of each frame, of tf and tf_static together."""

    def __init__(self, camera: CameraConfig) -> None:
        """Know only what the surroundings say: the pose of the camera, which also stands for unknown frames."""
        self._T_world_camera = transform(rpy_to_matrix(*camera.rpy), camera.position)
        self._newest: dict[str, TransformStamped] = {}

    def update(self, m: TFMessage) -> bool:
        """Take over transforms; whether a frame is new."""
        known = len(self._newest)
        self._newest.update((each.child_frame_id, each) for each in m.transforms)
        return len(self._newest) > known

    def message(self) -> TFMessage:
        """The newest transform of every frame."""
        return TFMessage(transforms=list(self._newest.values()))

    def pose(self, frame: str) -> Array:
        """(4, 4) T_world_frame, or what the surroundings say when transforms do not lead to world."""
        T, seen = np.eye(4), set()
        while frame not in ("", "world"):
            each = self._newest.get(frame)
            if each is None or frame in seen:
                return self._T_world_camera
            seen.add(frame)
            T = pose_to_matrix(each.transform) @ T
            frame = each.header.frame_id
        return T
