"""Balls on the table as things that persist: ids of our own for what is seen from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Place = tuple[float, float, float]


@dataclass
class Track:
    """One ball: where it was seen last [m], in world, how often, and when [s]."""

    id: str
    position: Place
    seen: int
    last_seen: float


class Tracks:
    """Matches detections to known balls, one to one, nearest pairs first."""

    def __init__(self, match_radius: float, confirm: int, forget_after: float, smoothing: float, still: float) -> None:
        """Start with no balls.

        Args:
            match_radius: a detection within this of a ball is that ball [m].
            confirm: a ball exists once it was seen in this many frames.
            forget_after: a ball not seen for this long is gone [s].
            smoothing: weight of the newest detection of a ball that lies still, 0 to 1.
            still: a ball displaced by less than this lies still and is smoothed [m].
        """
        self.match_radius, self.confirm, self.forget_after = match_radius, confirm, forget_after
        self.smoothing, self.still = smoothing, still
        self._tracks: list[Track] = []
        self._count = 0

    def update(self, positions: Sequence[Place], now: float) -> None:
        """Take in all detections of one frame, taken at `now` [s]."""
        pairs = sorted(
            (math.dist(t.position, p), i, j)
            for i, t in enumerate(self._tracks)
            for j, p in enumerate(positions)
            if math.dist(t.position, p) <= self.match_radius
        )
        matched_tracks: set[int] = set()
        matched: set[int] = set()
        for distance, i, j in pairs:
            if i in matched_tracks or j in matched:
                continue
            matched_tracks.add(i)
            matched.add(j)
            track, weight = self._tracks[i], self.smoothing if distance < self.still else 1.0
            x, y, z = (a + weight * (b - a) for a, b in zip(track.position, positions[j], strict=True))
            track.position, track.seen, track.last_seen = (x, y, z), track.seen + 1, now
        self._tracks = [t for t in self._tracks if now - t.last_seen <= self.forget_after]
        for j, position in enumerate(positions):
            if j not in matched:
                self._count += 1
                self._tracks.append(Track(f"track_{self._count}", position, 1, now))

    def confirmed(self) -> list[Track]:
        """Balls that were seen often enough to be believed."""
        return [t for t in self._tracks if t.seen >= self.confirm]

    def take(self, position: Place, radius: float) -> Track | None:
        """The ball nearest to a position, within `radius` [m], which is no longer tracked after this."""
        near = min(self._tracks, key=lambda t: math.dist(t.position, position), default=None)
        if near is None or math.dist(near.position, position) > radius:
            return None
        self._tracks.remove(near)
        return near

    def new_id(self) -> str:
        """An id for a ball that was never seen on the table."""
        self._count += 1
        return f"track_{self._count}"
