"""The camera of each picture: intrinsics from camera_info, where it was then from tf_static, and tf if it moves."""

from __future__ import annotations

import asyncio

from common import topics
from common.config import Surroundings
from common.messages import CameraInfo, Header
from common.perception.camera_input import CameraCache, FrameError
from common.perception.pinhole import Pinhole
from common.topics import Topic
from common.transport.bus import Bus

PATIENCE = 0.3  # [s, wall time] for which a picture waits for tf, which comes 50 times a second


class CameraReader:
    """Reads what tells of a camera. `follow` is to run beside whoever asks."""

    def __init__(self, bus: Bus, around: Surroundings, info: Topic[CameraInfo] = topics.CAMERA_INFO) -> None:
        """Declare the readers; tf is read only where a camera sits on the robot."""
        self._infos, self._statics = bus.reader(info), bus.reader(topics.TF_STATIC)
        self._on_robot = {camera.frame for camera in around.cameras.values() if camera.mount}
        self._tf = bus.reader(topics.TF) if self._on_robot else None
        self._cameras = CameraCache()
        self._news = asyncio.Event()

    async def follow(self) -> None:
        """Keep where frames are; returns at once where no camera moves."""
        if self._tf is None:
            return
        async for message in self._tf:
            self._cameras.moving.note(message)
            self._news.set()

    def moves(self, frame_id: str = "") -> bool:
        """Whether the camera of that frame, or else of camera_info, sits on the robot."""
        info = self._infos.latest
        return (frame_id or (info.header.frame_id if info else "")) in self._on_robot

    @property
    def without_robot(self) -> bool:
        """Whether the camera says that its pictures leave the robot out."""
        info = self._infos.latest
        return info is not None and info.without_robot

    async def of(self, picture: Header, *, own_frame: bool = True) -> Pinhole:
        """The camera of a picture, where it was when that was taken.

        Args:
            picture: its stamp and frame.
            own_frame: whether the frame is the camera's; else that of camera_info is meant.

        Raises:
            FrameError: it is not known, or nobody said within a moment where it was.
        """
        frame = picture.frame_id if own_frame else ""
        if not self.moves(frame):
            return self._now(frame, picture.stamp)
        try:
            async with asyncio.timeout(PATIENCE):
                while True:
                    self._news.clear()
                    try:
                        return self._now(frame, picture.stamp)
                    except FrameError as error:
                        if error.kind != "early":
                            raise
                    await self._news.wait()
        except TimeoutError:
            return self._now(frame, picture.stamp)

    def _now(self, frame: str, stamp: int) -> Pinhole:
        moves = self.moves(frame)
        return self._cameras.of(self._infos.latest, self._statics.latest, frame, stamp, moves=moves)
