"""What one or several detectors found, each with the camera that it looked through."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from applications.pick_place.topics import DETECTED_OBJECTS
from common import topics
from common.config import Parameters, RobotConfig, Surroundings
from common.messages import Marker, MarkerArray
from common.perception.camera_input import FrameError, SkippedFrames, require_capacity
from common.perception.occlusion import Occlusion, RobotOcclusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.process.camera_reader import CameraReader
from common.robot.model import RobotModel
from common.scene.home import HomeWatch
from common.transport.bus import Bus

OLDEST = 0.5  # [s, cell time] behind the newest: a camera that is so late says nothing of how things are now

ViewName = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*$")]


class ViewsParameters(Parameters):
    """Whose detections are looked at."""

    views: list[ViewName] = Field([], description="names of several detectors' views, as left: left/detected_objects, "
                                                  "left/camera/camera_info")


@dataclass(frozen=True)
class Seen:
    """A frame of detections and the camera that took the picture.

    A camera on the robot looks `at_times`, from home: its frame is what is known until it looks again. What cannot be
    judged in the picture of a fixed one is `hidden`, and no detection of the frame reaches into that.
    """

    frame: MarkerArray
    camera: Pinhole
    at_times: bool = False
    hidden: Occlusion | None = None


class Views:
    """Readers for each view: what was detected, and the camera. A view called left has its keys under `left/`."""

    def __init__(
        self, bus: Bus, names: Sequence[str], around: Surroundings, robot: RobotConfig, log: logging.Logger, *,
        only_at_home: bool = False,
    ) -> None:
        """Declare the readers.

        Args:
            bus: of the service.
            names: of the views; none stands for a single one, whose keys begin with nothing.
            around: which cameras sit on the robot: of those only frames count that were taken from home.
            robot: where home is.
            only_at_home: that holds for all cameras.
            log: is told once for each reason why a frame is left out.
        """
        keys = [f"{name}/" for name in names] or [""]
        self._frames = [bus.reader(replace(DETECTED_OBJECTS, key=f"{at}{DETECTED_OBJECTS.key}")) for at in keys]
        self._cameras = [
            CameraReader(bus, around, replace(topics.CAMERA_INFO, key=f"{at}{topics.CAMERA_INFO.key}")) for at in keys
        ]
        self._joints = bus.reader(topics.JOINT_STATES)
        self._watches_home = only_at_home or around.on_hand
        self._radius, self._config = around.ball_radius, robot
        self._robot: tuple[RobotModel, RobotSilhouettes] | None = None
        self._before: dict[int, RobotOcclusion] = {}
        self._views = list(names)
        self._names, self._home = robot.joints, HomeWatch(robot.named_poses["home"])
        self._only_at_home = only_at_home
        self._newest: list[Seen | None] = [None for _ in keys]
        self._left_out = SkippedFrames(log, "frame of detections")

    async def watch(self, look: Callable[[int, Seen], Awaitable[None]]) -> None:
        """Have every frame looked at as it comes, one after the other, with the number of its view; never returns."""
        turn = asyncio.Lock()

        async def follow(number: int) -> None:
            async for frame in self._frames[number]:
                cameras, stamp = self._cameras[number], frame.header.stamp
                moves = cameras.moves()
                if (moves or self._only_at_home) and not self._home.covers(stamp):
                    continue
                try:
                    require_capacity(len(frame.markers))
                    camera = await cameras.of(frame.header, own_frame=False)
                except FrameError as error:
                    self._left_out.note(error)
                    continue
                hidden = self._hidden(number, frame, camera) if not moves else None
                clear = _clear_of(frame, hidden, self._radius)
                seen = self._newest[number] = Seen(self._without_cut_off(number, clear), camera, moves, hidden)
                async with turn:
                    await look(number, seen)

        async with asyncio.TaskGroup() as group:
            group.create_task(self._watch_arm())
            for cameras in self._cameras:
                group.create_task(cameras.follow())
            for number in range(len(self._frames)):
                group.create_task(follow(number))

    def newest(self) -> list[Seen]:
        """The newest frame of each view that tells of now; that of a camera on the robot does until it looks again."""
        found = [seen for seen in self._newest if seen is not None]
        latest = max((seen.frame.header.stamp for seen in found), default=0)
        return [seen for seen in found
                if seen.at_times or latest - seen.frame.header.stamp <= OLDEST * 1e9]

    def missing(self) -> list[str]:
        """Names of the views of which nothing tells of now."""
        now = {id(seen) for seen in self.newest()}
        return [name for name, seen in zip(self._views, self._newest, strict=False) if id(seen) not in now]

    async def _watch_arm(self) -> None:
        if not self._watches_home:
            return
        async for state in self._joints:
            found = dict(zip(state.name, state.position, strict=True))
            if all(name in found for name in self._names):
                self._home.note([found[name] for name in self._names], state.header.stamp)

    @property
    def robot(self) -> tuple[RobotModel, RobotSilhouettes]:
        """A robot of its own and its outlines, read when somebody asks for the first time."""
        if self._robot is None:
            robot = RobotModel.load(self._config)
            self._robot = robot, RobotSilhouettes(robot, self._radius)
        return self._robot

    def _hidden(self, number: int, frame: MarkerArray, camera: Pinhole) -> Occlusion | None:
        """What cannot be judged in a picture: all of it, or what the robot is before."""
        if frame.blind:
            return Occlusion(camera, frame.blind)
        if self._cameras[number].without_robot:
            return None
        robot, silhouettes = self.robot
        before = self._before.setdefault(number, RobotOcclusion(silhouettes))
        state = self._joints.latest
        q = robot.order(state.name, state.position) if state is not None else None
        return before.in_image(camera, frame.header.stamp, q, state.header.stamp if state is not None else 0)

    def _without_cut_off(self, number: int, frame: MarkerArray) -> MarkerArray:
        """The frame without what is cut off by the border of its picture and whole in another one."""
        others = [seen for index, seen in enumerate(self._newest) if seen is not None and index != number]
        whole = [marker for seen in others for marker in seen.frame.markers if not marker.partial]
        kept = [
            marker for marker in frame.markers
            if not (marker.partial and any(math.dist(_place(marker), _place(one)) < marker.scale.x for one in whole))
        ]
        return frame if len(kept) == len(frame.markers) else frame.model_copy(update={"markers": kept})


def _clear_of(frame: MarkerArray, hidden: Occlusion | None, radius: float) -> MarkerArray:
    """The frame without what reaches into the part of its picture that cannot be judged: it is held, or cut off."""
    if hidden is None or not frame.markers:
        return frame
    behind = hidden.touches([_place(marker) for marker in frame.markers], radius)
    kept = [marker for marker, away in zip(frame.markers, behind, strict=True) if not away]
    return frame if len(kept) == len(frame.markers) else frame.model_copy(update={"markers": kept})


def _place(marker: Marker) -> tuple[float, float, float]:
    return marker.pose.position.x, marker.pose.position.y, marker.pose.position.z
