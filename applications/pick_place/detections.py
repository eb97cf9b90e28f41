"""Frames of one or several detectors, and which detections are offered to the task."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from applications.pick_place.ball_places import BallGeometry
from applications.pick_place.topics import DETECTED_OBJECTS
from common import topics
from common.config import Arms, Parameters, RobotConfig, Surroundings
from common.messages import Marker, MarkerArray, Rejection, Vector3
from common.messages.camera import INSIDE_CONTAINER, PARTLY_OUT_OF_VIEW
from common.perception.camera_input import FrameError, SkippedFrames, require_capacity
from common.perception.occlusion import Occlusion, RobotOcclusion, RobotSilhouettes
from common.perception.pinhole import Pinhole
from common.process.camera_reader import CameraReader
from common.robot.home import HomeMonitor
from common.robot.model import RobotModel
from common.scene.workspace import ReachCache
from common.transport.bus import Bus

Array = NDArray[np.float64]

OLDEST = 0.5  # [s, cell time] a camera this far behind the newest one does not show the current state

ViewName = Annotated[str, Field(pattern=r"^[A-Za-z_]\w*$")]


class ViewsParameters(Parameters):
    """Which detectors are read."""

    views: list[ViewName] = Field([], description="names of several detectors' views, as left: left/detected_objects, "
                                                  "left/camera/camera_info")


@dataclass(frozen=True)
class CameraDetections:
    """Detections of one image and the camera that took it.

    A camera on the robot looks only `at_times`, from home: its detections stay valid until it looks again. `hidden` is
    the part of a fixed camera's image that cannot be used; no detection reaches into it.
    """

    frame: MarkerArray
    camera: Pinhole
    at_times: bool = False
    hidden: Occlusion | None = None


class DetectionViews:
    """Readers of detections and camera info, one pair for each view; a view named left has its keys below `left/`."""

    def __init__(
        self, bus: Bus, names: Sequence[str], around: Surroundings, robot: RobotConfig, arms: Arms,
        log: logging.Logger, *, only_at_home: bool = False,
    ) -> None:
        """Declare the readers.

        Args:
            bus: of the service.
            names: of the views; none means a single view without a prefix.
            around: which cameras are on the robot; only their images taken from home count.
            robot: its home pose.
            arms: the others of the cell, which occlude too.
            only_at_home: treat all cameras like that.
            log: receives each reason for a skipped frame once.
        """
        keys = [f"{name}/" for name in names] or [""]
        self._frames = [bus.reader(replace(DETECTED_OBJECTS, key=f"{at}{DETECTED_OBJECTS.key}")) for at in keys]
        self._cameras = [
            CameraReader(bus, around, replace(topics.CAMERA_INFO, key=f"{at}{topics.CAMERA_INFO.key}")) for at in keys
        ]
        self._arms = [(bus.of_arm(arm).reader(topics.JOINT_STATES), config)
                      for arm, config in arms.including(robot).items()]
        self._joints = self._arms[0][0]
        self._watches_home = only_at_home or around.on_hand
        self._radius = around.ball_radius
        self._before: dict[tuple[int, int], RobotOcclusion] = {}  # by view and arm
        self._views = list(names)
        self._names, self._home = robot.joints, HomeMonitor(robot.named_poses["home"])
        self._only_at_home = only_at_home
        self._newest: list[CameraDetections | None] = [None for _ in keys]
        self._left_out = SkippedFrames(log, "frame of detections")

    async def watch(self, look: Callable[[int, CameraDetections], Awaitable[None]]) -> None:
        """Call `look` with every frame and the number of its view, one after the other; never returns."""
        turn = asyncio.Lock()

        async def follow(number: int) -> None:
            async for frame in self._frames[number]:
                cameras, stamp = self._cameras[number], frame.header.stamp
                moves = cameras.moves()
                if (moves or self._only_at_home) and not self._home.was_home(stamp):
                    continue
                try:
                    require_capacity(len(frame.markers))
                    camera = await cameras.of(frame.header, own_frame=False)
                except FrameError as error:
                    self._left_out.note(error)
                    continue
                hidden = self._hidden(number, frame, camera) if not moves else None
                clear = _clear_of(frame, hidden, self._radius)
                seen = CameraDetections(self._without_cut_off(number, clear), camera, moves, hidden)
                self._newest[number] = seen
                async with turn:
                    await look(number, seen)

        async with asyncio.TaskGroup() as group:
            group.create_task(self._watch_arm())
            for cameras in self._cameras:
                group.create_task(cameras.follow())
            for number in range(len(self._frames)):
                group.create_task(follow(number))

    def newest(self) -> list[CameraDetections]:
        """Return the newest frame of each view that is current; of a camera on the robot until it looks again."""
        found = [seen for seen in self._newest if seen is not None]
        latest = max((seen.frame.header.stamp for seen in found), default=0)
        return [seen for seen in found
                if seen.at_times or latest - seen.frame.header.stamp <= OLDEST * 1e9]

    def missing(self) -> list[str]:
        """Return the names of the views without a current frame."""
        now = {id(seen) for seen in self.newest()}
        return [name for name, seen in zip(self._views, self._newest, strict=False) if id(seen) not in now]

    async def _watch_arm(self) -> None:
        if not self._watches_home:
            return
        async for state in self._joints:
            found = dict(zip(state.name, state.position, strict=True))
            if all(name in found for name in self._names):
                self._home.add([found[name] for name in self._names], state.header.stamp)

    @property
    def robot(self) -> tuple[RobotModel, RobotSilhouettes]:
        """Robot model and silhouettes, loaded on first use."""
        return self._robots[0]

    @cached_property
    def _robots(self) -> list[tuple[RobotModel, RobotSilhouettes]]:
        models = [RobotModel.load(config) for _, config in self._arms]
        return [(robot, RobotSilhouettes(robot, self._radius)) for robot in models]

    def _hidden(self, number: int, frame: MarkerArray, camera: Pinhole) -> Occlusion | None:
        """Return what cannot be used in an image: all of it, or what robots occlude."""
        if frame.blind:
            return Occlusion(camera, frame.blind)
        if self._cameras[number].without_robot:
            return None
        hidden: Occlusion | None = None
        for arm, (robot, silhouettes) in enumerate(self._robots):
            before = self._before.setdefault((number, arm), RobotOcclusion(silhouettes))
            state = self._arms[arm][0].latest
            q = robot.order(state.name, state.position) if state is not None else None
            own = before.in_image(camera, frame.header.stamp, q, state.header.stamp if state is not None else 0)
            hidden = own.joined(hidden) if own is not None else hidden
        return hidden

    def _without_cut_off(self, number: int, frame: MarkerArray) -> MarkerArray:
        """Return the frame without detections cut off by its border that another view shows completely."""
        others = [seen for index, seen in enumerate(self._newest) if seen is not None and index != number]
        whole = [marker for seen in others for marker in seen.frame.markers if not marker.partial]
        remaining = [
            marker for marker in frame.markers
            if not (marker.partial and any(math.dist(_place(marker), _place(one)) < marker.scale.x for one in whole))
        ]
        return frame if len(remaining) == len(frame.markers) else frame.model_copy(update={"markers": remaining})


def _clear_of(frame: MarkerArray, hidden: Occlusion | None, radius: float) -> MarkerArray:
    """Return the frame without detections that reach into the occluded part: they are held, or cut off."""
    if hidden is None or not frame.markers:
        return frame
    behind = hidden.touches([_place(marker) for marker in frame.markers], radius)
    remaining = [marker for marker, away in zip(frame.markers, behind, strict=True) if not away]
    return frame if len(remaining) == len(frame.markers) else frame.model_copy(update={"markers": remaining})


def _place(marker: Marker) -> tuple[float, float, float]:
    return marker.pose.position.x, marker.pose.position.y, marker.pose.position.z


Place = tuple[float, float, float]

HIDDEN = "hidden"  # label of a target that was seen before something occluded it


class OccludedTargets:
    """Remembers targets while their positions are occluded."""

    def __init__(self, same_place: float = 0.03) -> None:
        """Start without targets.

        Args:
            same_place: detections closer than this are at the same position [m].
        """
        self._same_place = same_place
        self._before: list[Place] = []

    def hidden(
        self, targets: list[Place], others: Iterable[Place], hides: Callable[[Place], bool] | None
    ) -> list[Place]:
        """Return earlier targets that are not in this frame because their positions are occluded in it.

        Args:
            targets: of the frame [m].
            others: other detections of the frame, which are at their positions now [m].
            hides: whether a position is occluded; None: no position is.
        """
        shown = [*targets, *others]
        remaining = [] if hides is None else [
            place for place in self._before
            if all(math.dist(place, one) >= self._same_place for one in shown) and hides(place)
        ]
        self._before = [*targets, *remaining]
        return remaining


ODD_FOR = 0.5  # [s] for which an outlier must be detected at a position before it is reported


@dataclass
class ValidationResult:
    """Result for the detections of one frame; positions are (x, y, z) [m] in world.

    Attributes:
        targets: can be taken.
        rejections: cannot be taken, with the reason; only those not reported before.
        inside: number of detections in the container: neither targets nor rejections.
        unknown: need inverse kinematics first.
        refused: all that cannot be taken, with the reason, reported before or not.
        remarks: of the detectors.
    """

    targets: list[Place] = field(default_factory=list)
    rejections: list[Rejection] = field(default_factory=list)
    inside: int = 0
    unknown: list[Place] = field(default_factory=list)
    refused: list[tuple[Place, str]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def remark(self) -> str:
        """Text about detections that are not targets; empty without any."""
        parts = list(dict.fromkeys(self.remarks))
        if self.refused:
            count, reason = len(self.refused), self.refused[0][1]
            parts.append(f"{count} of {count + len(self.targets)} {'was' if count == 1 else 'were'} rejected, "
                         f"{'' if count == 1 else 'the first as '}{reason}")
        return ", and ".join(parts)


@dataclass
class _Reported:
    place: Place
    seen: int  # stamp of the newest frame with a detection there [ns]


@dataclass
class _Suspect(_Reported):
    since: int  # [ns]


class Validation:
    """Validates the detections of successive frames; reports each rejection once for each position."""

    def __init__(
        self, around: Surroundings, reach: ReachCache, *, forget_after: float = 2.0, same_place: float = 0.03
    ) -> None:
        """Start with nothing reported.

        Args:
            around: container and size of the balls.
            reach: reachability of positions on the table.
            forget_after: time without detection after which a position is reported again [s, cell time]; may change.
            same_place: detections closer than this are at the same position [m]; less than the distance of balls.
        """
        self._resting = BallGeometry.of(around)
        self._others = [replace(self._resting, container=around.containers[name]) for name in around.destinations
                        if around.containers[name] != around.container]  # filled by other arms
        self._reach = reach
        self.forget_after = forget_after
        self._same_place = same_place
        self._reported: list[_Reported] = []
        self._outliers: list[_Suspect] = []

    def validate_views(self, views: Sequence[tuple[MarkerArray, Pinhole]]) -> ValidationResult:
        """Validate several views; each position counts once."""
        joined = ValidationResult()
        for frame, camera in views:
            result = self.validate(frame, camera)
            known = list(joined.targets)
            joined.targets += [p for p in result.targets if all(math.dist(p, q) >= self._same_place for q in known)]
            joined.rejections += result.rejections
            joined.inside += result.inside
            joined.unknown += result.unknown
            others = [place for place, _ in joined.refused]
            joined.refused += [(p, why) for p, why in result.refused
                               if all(math.dist(p, q) >= self._same_place for q in others)]
            joined.remarks += result.remarks
        return joined

    def validate(self, frame: MarkerArray, camera: Pinhole) -> ValidationResult:
        """Validate a frame. The same frame may be validated again when more is known."""
        result = ValidationResult(remarks=[frame.remark] if frame.remark else [])
        stamp = frame.header.stamp
        self._reported = [known for known in self._reported if stamp - known.seen <= self.forget_after * 1e9]
        for marker in frame.markers:
            place, reason = self._reason(marker, camera)
            if reason is None:
                result.unknown.append(place)
            elif reason == INSIDE_CONTAINER:
                result.inside += 1
            elif any(other.shows_container(camera, self._pixel(marker, camera)) for other in self._others):
                continue
            elif reason:
                result.refused.append((place, reason))
                # A falling object is an outlier for a moment; a carried one may cross the border of the image.
                if not (marker.text or marker.partial) or self._stays(place, stamp):
                    self._report(result, place, reason, stamp)
            else:
                result.targets.append(place)
        return result

    def unknown(self, frame: MarkerArray, camera: Pinhole) -> list[Place]:
        """Return the positions in a frame that need inverse kinematics before they can be validated."""
        judged = (self._reason(marker, camera) for marker in frame.markers)
        return [place for place, reason in judged if reason is None]

    def _reason(self, marker: Marker, camera: Pinhole) -> tuple[Place, str | None]:
        """Return a position and why it is no target: empty when it is one, None while unknown."""
        place = (marker.pose.position.x, marker.pose.position.y, marker.pose.position.z)
        if self._resting.shows_container(camera, self._pixel(marker, camera)):
            return place, INSIDE_CONTAINER
        if marker.text:  # the detector's reason against taking it
            return place, marker.text
        return place, PARTLY_OUT_OF_VIEW if marker.partial else self._reach.known(place)

    def _pixel(self, marker: Marker, camera: Pinhole) -> Sequence[float] | Array:
        return marker.pixel if marker.pixel is not None else camera.project(_place(marker))

    def _stays(self, place: Place, stamp: int) -> bool:
        """Return whether an outlier has been there long enough."""
        self._outliers = [one for one in self._outliers if stamp - one.seen <= ODD_FOR * 1e9]
        for one in self._outliers:
            if math.dist(one.place, place) < self._same_place:
                one.seen = max(one.seen, stamp)
                return stamp - one.since >= ODD_FOR * 1e9
        self._outliers.append(_Suspect(place, stamp, stamp))
        return False

    def _report(self, result: ValidationResult, place: Place, reason: str, stamp: int) -> None:
        for known in self._reported:
            if math.dist(known.place, place) < self._same_place:
                known.seen, known.place = max(known.seen, stamp), place
                return
        self._reported.append(_Reported(place, stamp))
        result.rejections.append(Rejection(position=Vector3(x=place[0], y=place[1], z=place[2]), reason=reason))
