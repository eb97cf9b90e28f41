"""Frames of one or several detectors, and which detections are offered to the task."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

from pydantic import Field

from applications.pick_place.ball_places import Resting
from applications.pick_place.topics import DETECTED_OBJECTS
from common import topics
from common.config import Parameters, RobotConfig, Surroundings
from common.messages import Marker, MarkerArray, Rejection, Vector3
from common.perception.camera_input import FrameError, SkippedFrames, require_capacity
from common.perception.occlusion import Occlusion, RobotOcclusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.process.camera_reader import CameraReader
from common.robot.model import RobotModel
from common.scene.home import HomeWatch
from common.scene.workspace import INSIDE_CONTAINER, PARTLY_OUT_OF_VIEW, ReachCache
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
        self._left_out = SkippedFrames(log, "a frame of detections")

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
        return before.in_picture(camera, frame.header.stamp, q, state.header.stamp if state is not None else 0)

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


Place = tuple[float, float, float]

HIDDEN = "hidden"  # label of a target that was seen before something hid it


class Remembered:
    """Keeps targets while their places are hidden: what nobody sees is not gone."""

    def __init__(self, same_place: float = 0.03) -> None:
        """Start with nothing seen.

        Args:
            same_place: detections within this are at the same place [m].
        """
        self._same_place = same_place
        self._before: list[Place] = []

    def hidden(
        self, targets: list[Place], others: Iterable[Place], hides: Callable[[Place], bool] | None
    ) -> list[Place]:
        """Targets of before that are not among those of this frame, and whose places it does not show.

        Args:
            targets: of the frame [m].
            others: what else the frame shows, which is at its place now [m].
            hides: whether a place cannot be judged in it; None: all of it can.
        """
        shown = [*targets, *others]
        kept = [] if hides is None else [
            place for place in self._before
            if all(math.dist(place, one) >= self._same_place for one in shown) and hides(place)
        ]
        self._before = [*targets, *kept]
        return kept


ODD_FOR = 0.5  # [s] for which a detector finds something odd at a place before that is told


@dataclass
class Verdict:
    """What became of the detections of one frame; places are (x, y, z) [m] in world.

    Attributes:
        targets: can be taken.
        rejections: cannot, with the reason; only those that were not told before.
        inside: number of those in the container, which are nobody's target and no rejection.
        unknown: inverse kinematics has to tell first.
        refused: all that cannot be taken, and why, told before or not.
        remarks: of who made the frames.
    """

    targets: list[Place] = field(default_factory=list)
    rejections: list[Rejection] = field(default_factory=list)
    inside: int = 0
    unknown: list[Place] = field(default_factory=list)
    refused: list[tuple[Place, str]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def remark(self) -> str:
        """What was seen and is no target, in words; empty when there is nothing of that kind."""
        parts = list(dict.fromkeys(self.remarks))
        if self.refused:
            count, reason = len(self.refused), self.refused[0][1]
            parts.append(f"{count} of {count + len(self.targets)} {'was' if count == 1 else 'were'} rejected, "
                         f"{'' if count == 1 else 'the first as '}{reason}")
        return ", and ".join(parts)


@dataclass
class _Told:
    place: Place
    seen: int  # stamp of the newest frame that shows something there [ns]


@dataclass
class _Suspect(_Told):
    since: int  # [ns]


class Validation:
    """Judges the detections of frame after frame. Says each rejection once for each place."""

    def __init__(
        self, around: Surroundings, reach: ReachCache, *, forget_after: float = 2.0, same_place: float = 0.03
    ) -> None:
        """Start with nothing told.

        Args:
            around: container and size of the balls.
            reach: answers for places on the table.
            forget_after: a place that was empty for so long is told again [s, cell time]; may be changed.
            same_place: detections within this are at the same place [m]; less than balls are apart.
        """
        self._resting = Resting.of(around)
        self._reach = reach
        self.forget_after = forget_after
        self._same_place = same_place
        self._told: list[_Told] = []
        self._odd: list[_Suspect] = []

    def judge_all(self, views: Sequence[tuple[MarkerArray, Pinhole]]) -> Verdict:
        """What becomes of what several views show, of which each place counts once."""
        joined = Verdict()
        for frame, camera in views:
            verdict = self.judge(frame, camera)
            known = list(joined.targets)
            joined.targets += [p for p in verdict.targets if all(math.dist(p, q) >= self._same_place for q in known)]
            joined.rejections += verdict.rejections
            joined.inside += verdict.inside
            joined.unknown += verdict.unknown
            others = [place for place, _ in joined.refused]
            joined.refused += [(p, why) for p, why in verdict.refused
                               if all(math.dist(p, q) >= self._same_place for q in others)]
            joined.remarks += verdict.remarks
        return joined

    def judge(self, frame: MarkerArray, camera: Pinhole) -> Verdict:
        """What becomes of the detections of a frame. The same frame may be judged again when more is known."""
        verdict = Verdict(remarks=[frame.remark] if frame.remark else [])
        stamp = frame.header.stamp
        self._told = [told for told in self._told if stamp - told.seen <= self.forget_after * 1e9]
        for marker in frame.markers:
            place, reason = self._reason(marker, camera)
            if reason is None:
                verdict.unknown.append(place)
            elif reason == INSIDE_CONTAINER:
                verdict.inside += 1
            elif reason:
                verdict.refused.append((place, reason))
                if not marker.text or self._stays(place, stamp):  # what falls looks odd for a moment
                    self._tell(verdict, place, reason, stamp)
            else:
                verdict.targets.append(place)
        return verdict

    def unknown(self, frame: MarkerArray, camera: Pinhole) -> list[Place]:
        """Places in a frame that need inverse kinematics before they can be judged."""
        judged = (self._reason(marker, camera) for marker in frame.markers)
        return [place for place, reason in judged if reason is None]

    def _reason(self, marker: Marker, camera: Pinhole) -> tuple[Place, str | None]:
        """Where a detection is, and why it is no target: empty when it is one, None when that is not known yet."""
        place = (marker.pose.position.x, marker.pose.position.y, marker.pose.position.z)
        pixel = marker.pixel if marker.pixel is not None else camera.project(place)
        if self._resting.shows_container(camera, pixel):
            return place, INSIDE_CONTAINER
        if marker.text:  # the detector says why it is nothing to be taken
            return place, marker.text
        return place, PARTLY_OUT_OF_VIEW if marker.partial else self._reach.known(place)

    def _stays(self, place: Place, stamp: int) -> bool:
        """Whether something odd has been there for a while."""
        self._odd = [one for one in self._odd if stamp - one.seen <= ODD_FOR * 1e9]
        for one in self._odd:
            if math.dist(one.place, place) < self._same_place:
                one.seen = max(one.seen, stamp)
                return stamp - one.since >= ODD_FOR * 1e9
        self._odd.append(_Suspect(place, stamp, stamp))
        return False

    def _tell(self, verdict: Verdict, place: Place, reason: str, stamp: int) -> None:
        for told in self._told:
            if math.dist(told.place, place) < self._same_place:
                told.seen, told.place = max(told.seen, stamp), place
                return
        self._told.append(_Told(place, stamp))
        verdict.rejections.append(Rejection(position=Vector3(x=place[0], y=place[1], z=place[2]), reason=reason))
