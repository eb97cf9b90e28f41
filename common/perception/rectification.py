"""Takes the distortion of a lens out of pictures."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from common.errors import ConfigError
from common.perception.calibration_file import CameraFile

Picture = npt.NDArray[np.uint8]


class Rectifier:
    """Makes pictures of a lens those of a pinhole with the same matrix, so that everybody can compute with that."""

    def __init__(self, camera: CameraFile) -> None:
        """Compute the maps once."""
        self._camera = camera
        self._maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        if any(camera.d):
            size = (camera.width, camera.height)
            first, second = cv2.initUndistortRectifyMap(
                camera.matrix, camera.distortion, np.eye(3), camera.matrix, size, cv2.CV_32FC1
            )
            self._maps = np.asarray(first, np.float32), np.asarray(second, np.float32)

    def __call__(self, picture: Picture, source: str) -> Picture:
        """The bgr8 picture without distortion.

        Raises:
            ConfigError: it has another size than the intrinsics are for.
        """
        require_size(picture, self._camera, source)
        if self._maps is None:
            return picture
        return np.asarray(cv2.remap(picture, *self._maps, cv2.INTER_LINEAR), np.uint8)


def require_size(picture: Picture, camera: CameraFile, source: str) -> None:
    """Return when the picture is as large as the camera's.

    Raises:
        ConfigError: it is not.
    """
    height, width = picture.shape[:2]
    if (width, height) != (camera.width, camera.height):
        expected = f"do not fit {source}, whose pictures are {width}x{height}"
        raise ConfigError("intrinsics", f"{camera.width}x{camera.height}", expected)
