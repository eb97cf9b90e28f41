"""What a lens does to a picture: distortion, put in as a real one does and taken out again as its driver does.

The picture is drawn by a pinhole that sees all that the lens sees, and each pixel of the lens looks up its place there.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from common.config import CameraConfig
from common.errors import ConfigError
from common.perception.camera_file import CameraFile, Rectifier

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

MARGIN = 2  # [px] about what the lens sees
LARGEST = 2.0  # times the picture's width and height
UNDONE = 0.1  # [px]


class Lens:
    """The lens of a camera of the world.

    Attributes:
        drawn: the camera without distortion for which pictures are to be drawn.
        d: what is left of the distortion in the pictures that come out.
    """

    def __init__(self, camera: CameraConfig, *, distorted: bool = False, rectify: bool = True) -> None:
        """Compute what is looked up, once.

        Args:
            camera: its `d` is the distortion: k1, k2, p1, p2, k3, ...
            distorted: whether pictures are seen through the lens at all; else as by a pinhole.
            rectify: take the distortion out again, as camera_opencv does.

        Raises:
            ConfigError: a distortion that no picture of a reasonable size can be drawn for.
        """
        self.drawn, self.d, self.model = camera, [0.0] * 5, "plumb_bob"
        self._maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        self._rectify = None
        if not distorted or not any(camera.d):
            return
        file = CameraFile(**camera.model_dump())
        v, u = np.mgrid[0:camera.height, 0:camera.width]
        ideal = file.undistorted(np.column_stack([u.ravel(), v.ravel()])).reshape(camera.height, camera.width, 2)
        low = np.floor(np.minimum(ideal.min(axis=(0, 1)), 0)) - MARGIN
        high = np.ceil(np.maximum(ideal.max(axis=(0, 1)), (camera.width - 1, camera.height - 1))) + MARGIN
        width, height = (high - low + 1).tolist()
        if not _is_undone(file, ideal) or width > LARGEST * camera.width or height > LARGEST * camera.height:
            raise ConfigError("world.camera.d", camera.d, f"bends a picture of {camera.width}x{camera.height} to more "
                                                          f"than {LARGEST:g} times its size")
        shifted = (ideal - low).astype(np.float32)
        self._maps = np.ascontiguousarray(shifted[..., 0]), np.ascontiguousarray(shifted[..., 1])
        self.drawn = camera.model_copy(update={
            "width": int(width), "height": int(height), "d": [],
            "cx": camera.cx - float(low[0]), "cy": camera.cy - float(low[1]),
        })
        if rectify:
            self._rectify = Rectifier(file)
        else:
            self.d, self.model = file.distortion.tolist(), file.distortion_model

    def bend(self, picture: Picture) -> Picture:
        """What the lens makes of a picture that was drawn: the same one where it has no distortion."""
        if self._maps is None:
            return picture
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), np.uint8)

    def come_out(self, picture: Picture) -> Picture:
        """What the camera sends of a picture that the sensor took: rectified, where it is to be."""
        return picture if self._rectify is None else self._rectify(picture, "the lens")


def _is_undone(camera: CameraFile, ideal: Array) -> bool:
    """Whether the lens shows the places (height, width, 2) [px] that were found at the pixels for which they stand."""
    if not np.isfinite(ideal).all():
        return False
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.concatenate([(ideal - middle) / focal, np.ones((*ideal.shape[:2], 1))], axis=-1).reshape(-1, 1, 3)
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    return bool(np.abs(back.reshape(-1, 2) - np.column_stack([u.ravel(), v.ravel()])).max() < UNDONE)
