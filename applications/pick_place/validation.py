"""Which detections are offered to the task, and why the others are not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from applications.pick_place.resting import Resting
from common.config import Surroundings
from common.messages import Marker, MarkerArray, Rejection, Vector3
from common.perception.pinhole import Pinhole
from common.scene.workspace import INSIDE_CONTAINER, PARTLY_OUT_OF_VIEW, ReachCache

Place = tuple[float, float, float]

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
