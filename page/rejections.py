"""Where something was rejected, until nothing is there any more: what the page counts and what it shows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from common.messages import MarkerArray, PoseArray, Rejections
from page.nodes import Position, position_of

SAME_PLACE = 0.03  # [m] a rejection this near to another, or to a target, is of the same thing
FORGET_AFTER = 3_000_000_000  # [ns, cell time] without a detection there; who rejects may take 2 s
MOST = 60  # that are kept


@dataclass(eq=False)
class Place:
    """A place with the reason, as of its newest rejection."""

    at: Position
    reason: str
    since: int  # stamp of the rejection [ns]
    seen: int  # newest time [ns] at which something was detected there


class RejectedPlaces:
    """The places, oldest rejection first."""

    def __init__(self) -> None:
        """Start without any."""
        self.places: list[Place] = []

    def hear(self, message: Any) -> None:
        """Take note of rejections, of targets, or of what was detected, all in world.

        Forgotten is where a target is by now, or where nothing has been detected for a while: whoever took it away.
        """
        if isinstance(message, Rejections | PoseArray | MarkerArray):
            self._keep_up(message.header.stamp)
        if isinstance(message, Rejections):
            self._add(message)
        elif isinstance(message, PoseArray):
            targets = [position_of(pose) for pose in message.poses]
            self.places = [p for p in self.places if message.header.stamp < p.since or not _near(p.at, targets)]
        elif isinstance(message, MarkerArray):
            found = [position_of(marker.pose) for marker in message.markers]
            for place in self.places:
                if _near(place.at, found):
                    place.seen = max(place.seen, message.header.stamp)
            self.places = [place for place in self.places if message.header.stamp - place.seen <= FORGET_AFTER]

    def _keep_up(self, stamp: int) -> None:
        """Count from a stamp [ns] that is long before what was seen: the clock was set back."""
        for place in self.places:
            if place.seen - stamp > FORGET_AFTER:
                place.since = place.seen = stamp

    def _add(self, message: Rejections) -> None:
        """Add these; one at a known place replaces it."""
        stamp = message.header.stamp
        for each in message.rejected:
            at = (each.position.x, each.position.y, each.position.z)
            self.places = [place for place in self.places if not _near(place.at, [at])]
            self.places = [*self.places, Place(at, each.reason, stamp, stamp)][-MOST:]


def _near(at: Position, places: list[Position]) -> bool:
    return any(math.dist(at, place) < SAME_PLACE for place in places)
