"""Camera models for images: intrinsics from camera_info, pose at the time of the image from tf_static and tf."""

from __future__ import annotations

import asyncio

from common import topics
from common.config import Surroundings
from common.messages import CameraInfo, Header
from common.perception.camera_input import CameraCache, FrameError
from common.perception.pinhole import Pinhole
from common.topics import Topic
from common.transport.bus import Bus

TF_TIMEOUT = 0.3  # [s, wall time] for which an image waits for its tf message; tf is published at 50 Hz


class CameraReader:
    """Reads the topics that describe a camera. Run `follow` concurrently with the code that calls `of`."""

    def __init__(self, bus: Bus, around: Surroundings, info: Topic[CameraInfo] = topics.CAMERA_INFO) -> None:
        """Subscribe; tf is read only if a camera is mounted on the robot."""
        self._infos, self._statics = bus.reader(info), bus.reader(topics.TF_STATIC)
        self._on_robot = {camera.frame for camera in around.cameras.values() if camera.mount}
        self._tf = bus.reader(topics.TF) if self._on_robot else None
        self._cameras = CameraCache()
        self._tf_changed = asyncio.Event()

    async def follow(self) -> None:
        """Record frames as they move; returns at once if no camera moves."""
        if self._tf is None:
            return
        async for message in self._tf:
            self._cameras.moving.add(message)
            self._tf_changed.set()

    def moves(self, frame_id: str = "") -> bool:
        """Return whether the camera of that frame, by default the one of camera_info, is mounted on the robot."""
        info = self._infos.latest
        return (frame_id or (info.header.frame_id if info else "")) in self._on_robot

    @property
    def without_robot(self) -> bool:
        """Whether the camera renders images without the robot."""
        info = self._infos.latest
        return info is not None and info.without_robot

    async def of(self, picture: Header, *, own_frame: bool = True) -> Pinhole:
        """Return the camera of an image, with its pose at the time of the image.

        Args:
            picture: header of the image, with stamp and frame.
            own_frame: whether that frame is the camera's; otherwise the frame of camera_info is used.

        Raises:
            FrameError: camera or pose are unknown, also after a short wait for tf.
        """
        frame = picture.frame_id if own_frame else ""
        if not self.moves(frame):
            return self._camera_at(frame, picture.stamp)
        try:
            async with asyncio.timeout(TF_TIMEOUT):
                while True:
                    self._tf_changed.clear()
                    try:
                        return self._camera_at(frame, picture.stamp)
                    except FrameError as error:
                        if error.kind != "early":
                            raise
                    await self._tf_changed.wait()
        except TimeoutError:
            return self._camera_at(frame, picture.stamp)

    def _camera_at(self, frame: str, stamp: int) -> Pinhole:
        moves = self.moves(frame)
        return self._cameras.of(self._infos.latest, self._statics.latest, frame, stamp, moves=moves)
