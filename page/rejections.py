"""Positions of rejected targets, until nothing is detected there any more."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from common.messages import MarkerArray, PoseArray, Rejections
from page.nodes import Position, position_of

SAME_DISTANCE = 0.03  # [m] within which rejections and detections belong to the same object
TIMEOUT = 3_000_000_000  # [ns, cell time] without a detection; a validator may take 2 s to reject
MAX_POSITIONS = 60


@dataclass(eq=False)
class RejectedPosition:
    """A position with the reason of its newest rejection."""

    at: Position
    reason: str
    since: int  # stamp of the rejection [ns]
    last_seen: int  # stamp of the newest detection there [ns]


class RejectedPositions:
    """The rejected positions, oldest rejection first."""

    def __init__(self) -> None:
        """Start empty."""
        self.positions: list[RejectedPosition] = []

    def update(self, message: Any) -> None:
        """Process rejections, targets, or detections, all in world.

        A position is forgotten when a target is there, or when nothing has been detected there for a while.
        """
        if isinstance(message, Rejections | PoseArray | MarkerArray):
            self._handle_clock_reset(message.header.stamp)
        if isinstance(message, Rejections):
            self._add(message)
        elif isinstance(message, PoseArray):
            targets = [position_of(pose) for pose in message.poses]
            self.positions = [
                p for p in self.positions if message.header.stamp < p.since or not _near(p.at, targets)]
        elif isinstance(message, MarkerArray):
            found = [position_of(marker.pose) for marker in message.markers]
            for position in self.positions:
                if _near(position.at, found):
                    position.last_seen = max(position.last_seen, message.header.stamp)
            self.positions = [p for p in self.positions if message.header.stamp - p.last_seen <= TIMEOUT]

    def _handle_clock_reset(self, stamp: int) -> None:
        """Restart the timeout of positions if a stamp [ns] shows that the clock was set back."""
        for position in self.positions:
            if position.last_seen - stamp > TIMEOUT:
                position.since = position.last_seen = stamp

    def _add(self, message: Rejections) -> None:
        """Add rejections; each replaces an earlier one at the same position."""
        stamp = message.header.stamp
        for each in message.rejected:
            at = (each.position.x, each.position.y, each.position.z)
            others = [position for position in self.positions if not _near(position.at, [at])]
            self.positions = [*others, RejectedPosition(at, each.reason, stamp, stamp)][-MAX_POSITIONS:]


def _near(at: Position, others: list[Position]) -> bool:
    return any(math.dist(at, other) < SAME_DISTANCE for other in others)
