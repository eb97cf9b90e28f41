"""Images and calibrations of a camera of ROS 2 as those of a camera of the cell."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bridges.ros2.inputs import stamp_of
from common.config import check
from common.errors import ConfigError
from common.messages import CameraInfo, Header, Image
from common.perception.camera_file import CameraFile, Rectifier
from common.perception.image import ImageError, array_to_image, image_to_array

TO_BGR = {"bgr8": None, "rgb8": cv2.COLOR_RGB2BGR, "mono8": cv2.COLOR_GRAY2BGR}
MODELS = ("plumb_bob", "rational_polynomial")  # of distortion, as OpenCV's


class Unusable(Exception):
    """Why an image or a calibration cannot be used."""


class Camera:
    """Converts images to rectified bgr8 ones with the camera's own stamps, in a frame of the cell."""

    def __init__(self, frame: str, rectified: bool) -> None:
        """Put messages into a frame; `rectified`: the images have no distortion and the intrinsics of P."""
        self._frame, self._rectified = frame, rectified
        self._given: Any = None  # newest calibration of ROS
        self._lens: tuple[CameraFile, Rectifier] | None = None
        self._last = 0

    def calibrate(self, info: Any) -> CameraInfo | None:
        """Take a sensor_msgs/CameraInfo over; return that of the cell if it changes.

        Raises:
            Unusable: it has no calibration, or of another lens model than a pinhole with OpenCV's distortion.
        """
        p, d = np.asarray(info.p).reshape(3, 4), [float(value) for value in info.d]
        k = p[:, :3] if self._rectified else np.asarray(info.k).reshape(3, 3)
        given = (info.width, info.height, k.tolist(), d, info.distortion_model)
        if given == self._given:
            return None
        if not k[0, 0] > 0:
            raise Unusable("camera_info has no calibration: calibrate the camera, or name the topic of one that is")
        if not self._rectified and any(d) and info.distortion_model not in MODELS:
            raise Unusable(f"distortion model {info.distortion_model!r} is not supported; choices: "
                           f"{', '.join(MODELS)}, or rectified images with `rectified`")
        try:
            lens = check(CameraFile, {
                "width": info.width, "height": info.height, "fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2],
                "cy": k[1, 2], "d": [] if self._rectified else d}, "camera_info")
        except ConfigError as error:
            raise Unusable(str(error)) from None
        self._lens, self._given = (lens, Rectifier(lens)), given
        return CameraInfo(header=Header(stamp=stamp_of(info.header), frame_id=self._frame), height=lens.height,
                          width=lens.width, d=[0.0] * 5, k=lens.matrix.ravel().tolist())

    def convert(self, message: Any, source: str) -> Image:
        """Return a sensor_msgs/Image as an image of the cell.

        Raises:
            Unusable: its encoding or size, its stamp, or there is no calibration yet.
        """
        if message.encoding not in TO_BGR:
            raise Unusable(f"encoding {message.encoding!r} is not supported; choices: {', '.join(TO_BGR)}")
        if self._lens is None:
            raise Unusable("no camera_info received yet")
        stamp = stamp_of(message.header)
        if stamp == self._last:
            raise Unusable("stamps repeat" if stamp else "images have no stamp")
        header = Header(stamp=stamp, frame_id=self._frame)
        try:
            pixels: npt.NDArray[np.uint8] = image_to_array(check(Image, {
                "header": header, "height": message.height, "width": message.width, "encoding": message.encoding,
                "step": message.step, "data": message.data.tobytes()}, "image"))
            code = TO_BGR[message.encoding]
            bgr = pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8)
            converted = array_to_image(self._lens[1](bgr, source), "bgr8", header)
        except (ImageError, ConfigError) as error:
            raise Unusable(str(error)) from None
        self._last = stamp
        return converted
