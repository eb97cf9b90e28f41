"""From messages to a picture and the camera that took it, or the reason why that cannot be."""

from __future__ import annotations

import logging
from collections import Counter

import numpy as np
import numpy.typing as npt

from common.errors import ZencellError
from common.messages import CameraInfo, Image, TFMessage
from common.perception.image import ImageError, image_to_array
from common.perception.pinhole import CameraError, Pinhole
from common.robot.transform_history import NoTransform, TransformHistory

Picture = npt.NDArray[np.uint8]

UNKNOWN_CAMERA = "unknown_camera"
FARTHEST = 1e7  # [m] along each axis that a message has room for
MAX_DETECTIONS = 250  # found in a picture: neither a list of targets nor a planning scene has room for many more


class FrameError(ZencellError):
    """A picture that cannot be looked at. `kind` tells causes apart: unknown_camera, camera, size, encoding, ..."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def require_capacity(things: int) -> None:
    """Return when so many things that were found in a picture can be told of; some of them are never left out.

    Raises:
        FrameError: they are too many.
    """
    if things > MAX_DETECTIONS:
        raise FrameError("crowded", f"{things} objects in it are more than a planning scene has room for: is the "
                                    "image full of noise?")


def require_in_range(places: npt.ArrayLike) -> None:
    """Return when places in world [m] that were told by a camera are so near that a message can say where they are.

    Raises:
        FrameError: one of them is farther, or not finite: the camera looks along the search plane, or is invalid.
    """
    if not (np.abs(np.asarray(places, dtype=float)) <= FARTHEST).all():
        raise FrameError("far", f"something in it would be more than {FARTHEST:g} m away: is the camera's pose right?")


class SkippedFrames:
    """Frames that could not be used: told once for each cause, counted after that."""

    def __init__(self, log: logging.Logger, what: str) -> None:
        """Tell of frames that are called `what` in the log of a service."""
        self._log, self._what = log, what
        self.counts: Counter[str] = Counter()

    def note(self, error: FrameError | ImageError) -> None:
        """Take note of a frame that was left out; that no camera is known yet is usual in the first moments."""
        self.counts[error.kind] += 1
        if self.counts[error.kind] == 1 and error.kind != UNKNOWN_CAMERA:
            self._log.warning("%s left out: %s (told once; further ones are counted)", self._what, error)


def resolve_camera(
    info: CameraInfo | None, fixed: TFMessage | None, frame_id: str = "", *, moving: TransformHistory | None = None,
    stamp: int = 0,
) -> Pinhole:
    """The camera that camera_info and tf describe, where it was when a picture was taken.

    Args:
        info: intrinsics.
        fixed: tf_static.
        frame_id: of the picture; that of `info` when empty.
        moving: tf, for a camera that hangs on what moves.
        stamp: of the picture [ns].

    Raises:
        FrameError: one of them is missing or says something that no pinhole camera does. Of kind `early` it may help to
            wait: the next message of tf may say where the camera was.
    """
    if info is None or fixed is None:
        missing = "camera_info" if info is None else "tf_static"
        raise FrameError(UNKNOWN_CAMERA, f"no {missing} came yet")
    history = moving if moving is not None else TransformHistory()
    try:
        return Pinhole.from_info(info, history.pose(frame_id or info.header.frame_id, fixed, stamp))
    except NoTransform as error:
        raise FrameError(error.kind, str(error)) from None
    except CameraError as error:
        raise FrameError("camera", str(error)) from None


class CameraCache:
    """`resolve_camera` that gives the same camera for the same messages, and for one that has not moved meanwhile."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self.moving = TransformHistory()
        self._last: tuple[CameraInfo, TFMessage, str, Pinhole] | None = None

    def of(
        self, info: CameraInfo | None, fixed: TFMessage | None, frame_id: str = "", stamp: int = 0, *,
        moves: bool = False,
    ) -> Pinhole:
        """The camera of a picture; one that `moves` is looked for in `moving` as well, at the time of the picture."""
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


def decode_image(image: Image, camera: Pinhole) -> Picture:
    """The bgr8 picture (height, width, 3) of an image message.

    Raises:
        FrameError: another size than the camera has, not a colour picture, or bytes that do not add up.
    """
    if (image.width, image.height) != (camera.width, camera.height):
        raise FrameError(
            "size", f"image of {image.width}x{image.height}, but camera_info says {camera.width}x{camera.height}"
        )
    return decode_color_image(image)


def decode_color_image(image: Image) -> Picture:
    """The bgr8 picture (height, width, 3) of an image message, whatever camera took it.

    Raises:
        FrameError: not a colour picture, or bytes that do not add up.
    """
    if image.encoding not in ("bgr8", "rgb8"):
        raise FrameError("encoding", f"encoding {image.encoding!r} is no colour picture; choices: bgr8, rgb8")
    try:
        pixels: Picture = image_to_array(image)
    except ImageError as error:
        raise FrameError(error.kind, str(error)) from None
    if image.encoding == "bgr8":
        return pixels
    import cv2  # many read clouds by this module, and no picture

    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), np.uint8)
