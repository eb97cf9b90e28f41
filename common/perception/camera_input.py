"""Decode camera messages: image, intrinsics and pose, or the reason why a frame is unusable."""

from __future__ import annotations

import logging
from collections import Counter

import numpy as np
import numpy.typing as npt

from common.errors import ZencellError
from common.messages import CameraInfo, Image, TFMessage
from common.perception.image import ImageError, image_to_array
from common.perception.pinhole import CameraError, Pinhole
from common.robot.transform_tree import TransformHistory, TransformUnavailable

Pixels = npt.NDArray[np.uint8]

UNKNOWN_CAMERA = "unknown_camera"
RANGE = 1e7  # [m] along each axis that a message can hold
MAX_DETECTIONS = 250  # in an image: limit of target lists and planning scenes


class FrameError(ZencellError):
    """An unusable frame. `kind` names the cause for programs: unknown_camera, camera, size, encoding, ..."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def require_capacity(count: int) -> None:
    """Check that a planning scene can hold all objects detected in an image; none is dropped silently.

    Raises:
        FrameError: there are more than `MAX_DETECTIONS`.
    """
    if count > MAX_DETECTIONS:
        raise FrameError("crowded", f"{count} objects in it are more than a planning scene has room for: is the "
                                    "image full of noise?")


def require_in_range(positions: npt.ArrayLike) -> None:
    """Check that positions in world [m], computed from a camera, are finite and fit into a message.

    Raises:
        FrameError: one is farther than `RANGE`, or not finite: the camera looks along the search plane, or is invalid.
    """
    if not (np.abs(np.asarray(positions, dtype=float)) <= RANGE).all():
        raise FrameError("far", f"an object would be more than {RANGE:g} m away: check the camera's pose")


class SkippedFrames:
    """Counts unusable frames by cause and logs the first of each cause."""

    def __init__(self, log: logging.Logger, what: str) -> None:
        """Log to the service's logger; `what` names the frames in the log."""
        self._log, self._what = log, what
        self.counts: Counter[str] = Counter()

    def note(self, error: FrameError | ImageError) -> None:
        """Count a skipped frame; log its cause the first time, except for a camera that is not known yet at start."""
        self.counts[error.kind] += 1
        if self.counts[error.kind] == 1 and error.kind != UNKNOWN_CAMERA:
            self._log.warning("%s skipped: %s (logged once; further ones are counted)", self._what, error)


def resolve_camera(
    info: CameraInfo | None, fixed: TFMessage | None, frame_id: str = "", *, moving: TransformHistory | None = None,
    stamp: int = 0,
) -> Pinhole:
    """Return the camera described by camera_info and tf, at its pose when an image was taken.

    Args:
        info: intrinsics.
        fixed: tf_static.
        frame_id: of the image; empty: that of `info`.
        moving: tf history, for a camera on a moving link.
        stamp: of the image [ns].

    Raises:
        FrameError: a message is missing, or describes no pinhole camera. After kind `early` retry with the next tf
            message: it may hold the pose at that time.
    """
    if info is None or fixed is None:
        missing = "camera_info" if info is None else "tf_static"
        raise FrameError(UNKNOWN_CAMERA, f"no {missing} received yet")
    history = moving if moving is not None else TransformHistory()
    try:
        return Pinhole.from_info(info, history.pose(frame_id or info.header.frame_id, fixed, stamp))
    except TransformUnavailable as error:
        raise FrameError(error.kind, str(error)) from None
    except CameraError as error:
        raise FrameError("camera", str(error)) from None


class CameraCache:
    """Caches `resolve_camera`: returns the same object while the messages and the pose are unchanged."""

    def __init__(self) -> None:
        """Start without a camera."""
        self.moving = TransformHistory()
        self._last: tuple[CameraInfo, TFMessage, str, Pinhole] | None = None

    def of(
        self, info: CameraInfo | None, fixed: TFMessage | None, frame_id: str = "", stamp: int = 0, *,
        moves: bool = False,
    ) -> Pinhole:
        """Return the camera of an image; for a camera that `moves`, at its pose in `moving` at `stamp` [ns]."""
        last = self._last
        same = last is not None and last[0] is info and last[1] is fixed and last[2] == frame_id
        if last is not None and same and not moves:
            return last[3]
        camera = resolve_camera(info, fixed, frame_id, moving=self.moving, stamp=stamp)
        if last is not None and same and np.array_equal(camera.T_world_optical, last[3].T_world_optical):
            return last[3]
        assert info is not None and fixed is not None
        self._last = (info, fixed, frame_id, camera)
        return camera


def decode_image(image: Image, camera: Pinhole) -> Pixels:
    """Return the bgr8 pixels (height, width, 3) of an image message of this camera.

    Raises:
        FrameError: the size differs from camera_info, the encoding is no color, or the data are inconsistent.
    """
    if (image.width, image.height) != (camera.width, camera.height):
        raise FrameError(
            "size", f"image of {image.width}x{image.height}, but camera_info says {camera.width}x{camera.height}"
        )
    return decode_color_image(image)


def decode_color_image(image: Image) -> Pixels:
    """Return the bgr8 pixels (height, width, 3) of an image message of any camera.

    Raises:
        FrameError: the encoding is no color, or the data are inconsistent.
    """
    if image.encoding not in ("bgr8", "rgb8"):
        raise FrameError("encoding", f"encoding {image.encoding!r} is no color image; choices: bgr8, rgb8")
    try:
        pixels: Pixels = image_to_array(image)
    except ImageError as error:
        raise FrameError(error.kind, str(error)) from None
    if image.encoding == "bgr8":
        return pixels
    import cv2  # readers of point clouds import this module without decoding images

    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), np.uint8)
