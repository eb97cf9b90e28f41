"""The YAML file of a calibrated camera: written by `zencell calibrate`, read by cells and by `camera_opencv`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import yaml
from pydantic import Field

from common.config import CameraConfig, Number, Parameters, check, read_yaml
from common.config.basics import Point
from common.errors import ConfigError
from common.perception.camera_formats import read_foreign

Array = npt.NDArray[np.float64]

_HEADER = """\
# A camera calibrated by `zencell calibrate`. A cell uses it with its pose by `--set world.camera={name}`,
# or by `camera: {name}` in a world file; all services then use it. Lengths in [m], angles in [rad].
"""


class CameraFile(Parameters):
    """A calibrated camera. `calibration` holds records for people; no computation reads them."""

    width: int = Field(ge=16, le=16384, description="[px]")
    height: int = Field(ge=16, le=16384, description="[px]")
    fx: float = Field(gt=1, le=1e5, description="focal length [px]")
    fy: float = Field(gt=1, le=1e5, description="focal length [px]")
    cx: float = Field(ge=0, le=16384, description="principal point [px]")
    cy: float = Field(ge=0, le=16384, description="principal point [px]")
    d: list[Number] = Field([], max_length=8, description="distortion k1, k2, p1, p2, k3, ... as OpenCV's plumb bob; "
                                                          "eight are the rational model")
    frame: str | None = Field(None, description="name of the optical frame; none: the frame of the world's camera")
    mount: str | None = Field(None, description="robot link that carries it, or tcp; none: fixed in world")
    position: Point | None = Field(None, description="optical centre in world, or in its mount [m]")
    rpy: tuple[Number, Number, Number] | None = Field(
        None, description="of the optical frame in world, or in its mount [rad], R = Rz Ry Rx"
    )
    calibration: dict[str, Any] = Field({}, description="record of the calibration: residuals, date, source")

    @classmethod
    def load(cls, path: str) -> CameraFile:
        """Load the camera from a YAML file, or its intrinsics from a file of ROS or OpenCV.

        Raises:
            ConfigError: the file cannot be read; or names the invalid field.
        """
        file = Path(path).expanduser()
        return check(cls, read_foreign(file) or read_yaml(file), path)

    @classmethod
    def of(cls, camera: CameraConfig) -> CameraFile:
        """Convert the camera of a world."""
        return cls(**camera.model_dump())

    def save(self, path: str) -> None:
        """Write the YAML file that `load` and a cell read.

        Raises:
            ConfigError: the file cannot be written.
        """
        values = {field: value for field, value in self.model_dump().items() if value is not None}
        values |= {field: [float(x) for x in values[field]] for field in ("position", "rpy") if field in values}
        output = Path(path).expanduser()
        text = yaml.safe_dump(_rounded(values), sort_keys=False, default_flow_style=None, width=110)
        try:
            output.write_text(_HEADER.format(name=output.name) + text, encoding="utf-8")
        except OSError as error:
            raise ConfigError("--output", path, f"cannot be written: {error.strerror}") from None

    @property
    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix [px]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> Array:
        """Distortion coefficients, zero-padded to a length that OpenCV accepts: 4, 5 or 8."""
        length = next(n for n in (4, 5, 8) if len(self.d) <= n)
        return np.array([*self.d, *[0.0] * (length - len(self.d))])

    @property
    def distortion_model(self) -> str:
        """Name of the distortion model as in sensor_msgs/CameraInfo."""
        return "rational_polynomial" if len(self.d) > 5 else "plumb_bob"

    def undistorted(self, pixels: npt.ArrayLike) -> Array:
        """(n, 2) pixels at which a pinhole with the same matrix sees the rays of distorted pixels (n, 2) [px]."""
        points = np.asarray(pixels, dtype=float).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        ideal = cv2.undistortPoints(points, self.matrix, self.distortion, P=self.matrix, criteria=criteria)
        return np.asarray(ideal, float)[:, 0]


def _rounded(value: Any) -> Any:
    """Round to nine digits: more precise than a camera, and still readable."""
    if isinstance(value, float):
        return round(value, 9)
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value


Pixels = npt.NDArray[np.uint8]


class Rectifier:
    """Removes lens distortion: its images are those of a pinhole with the same matrix."""

    def __init__(self, camera: CameraFile) -> None:
        """Compute the remapping once."""
        self._camera = camera
        self._maps: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]] | None = None
        if any(camera.d):
            size = (camera.width, camera.height)
            first, second = cv2.initUndistortRectifyMap(
                camera.matrix, camera.distortion, np.eye(3), camera.matrix, size, cv2.CV_32FC1
            )
            self._maps = np.asarray(first, np.float32), np.asarray(second, np.float32)

    def __call__(self, image: Pixels, source: str) -> Pixels:
        """Rectify a bgr8 image.

        Raises:
            ConfigError: the size differs from that of the intrinsics.
        """
        require_size(image, self._camera, source)
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)


def require_size(image: Pixels, camera: CameraFile, source: str) -> None:
    """Check that the image has the size of the camera's intrinsics.

    Raises:
        ConfigError: it has another size.
    """
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        expected = f"do not fit {source}, whose images are {width}x{height}"
        raise ConfigError("intrinsics", f"{camera.width}x{camera.height}", expected)
