"""The file of a calibrated camera: what `zencell calibrate` writes, and a cell and `camera_opencv` read."""

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

Array = npt.NDArray[np.float64]

_HEADER = """\
# A camera as `zencell calibrate` found it. A cell takes it with its pose as `--set world.camera={name}`,
# or as `camera: {name}` in a world file; then all services compute with it. Lengths in [m], angles in [rad].
"""


class CameraFile(Parameters):
    """A calibrated camera. What is not needed to compute with it stands under `calibration`, for people."""

    width: int = Field(ge=16, le=16384, description="[px]")
    height: int = Field(ge=16, le=16384, description="[px]")
    fx: float = Field(gt=1, le=1e5, description="focal length [px]")
    fy: float = Field(gt=1, le=1e5, description="focal length [px]")
    cx: float = Field(ge=0, le=16384, description="principal point [px]")
    cy: float = Field(ge=0, le=16384, description="principal point [px]")
    d: list[Number] = Field([], max_length=8, description="distortion k1, k2, p1, p2, k3, ... as OpenCV's plumb bob; "
                                                          "eight are the rational model")
    frame: str | None = Field(None, description="name of the optical frame; none: that of the world's camera")
    mount: str | None = Field(None, description="link of the robot that it sits on, or tcp; none: fixed in world")
    position: Point | None = Field(None, description="optical centre in world, or in its mount [m]")
    rpy: tuple[Number, Number, Number] | None = Field(
        None, description="of the optical frame in world, or in its mount [rad], R = Rz Ry Rx"
    )
    calibration: dict[str, Any] = Field({}, description="how it came about: residuals, date, source")

    @classmethod
    def load(cls, path: str) -> CameraFile:
        """The camera of a YAML file.

        Raises:
            ConfigError: the file cannot be read, or names the field that does not fit.
        """
        return check(cls, read_yaml(Path(path).expanduser()), path)

    @classmethod
    def of(cls, camera: CameraConfig) -> CameraFile:
        """The camera of a world."""
        return cls(**camera.model_dump())

    def save(self, path: str) -> None:
        """Write it as a YAML file that `load` and a cell read.

        Raises:
            ConfigError: it cannot be written.
        """
        values = {field: value for field, value in self.model_dump().items() if value is not None}
        values |= {field: [float(x) for x in values[field]] for field in ("position", "rpy") if field in values}
        place = Path(path).expanduser()
        text = yaml.safe_dump(_rounded(values), sort_keys=False, default_flow_style=None, width=110)
        try:
            place.write_text(_HEADER.format(name=place.name) + text, encoding="utf-8")
        except OSError as error:
            raise ConfigError("--output", path, f"cannot be written: {error.strerror}") from None

    @property
    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix [px]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> Array:
        """Coefficients, filled up with zeros to a number that OpenCV takes: 4, 5 or 8."""
        length = next(n for n in (4, 5, 8) if len(self.d) <= n)
        return np.array([*self.d, *[0.0] * (length - len(self.d))])

    @property
    def distortion_model(self) -> str:
        """Name of the model as in sensor_msgs/CameraInfo."""
        return "rational_polynomial" if len(self.d) > 5 else "plumb_bob"

    def undistorted(self, pixels: npt.ArrayLike) -> Array:
        """(n, 2) where a pinhole camera with the same matrix would see what the lens shows at pixels (n, 2) [px]."""
        points = np.asarray(pixels, dtype=float).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        ideal = cv2.undistortPoints(points, self.matrix, self.distortion, P=self.matrix, criteria=criteria)
        return np.asarray(ideal, float)[:, 0]


def _rounded(value: Any) -> Any:
    """Nine digits are more than a camera has, and can be read."""
    if isinstance(value, float):
        return round(value, 9)
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    return [_rounded(one) for one in value] if isinstance(value, list | tuple) else value


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
