"""Balls on the table as things that persist: ids of our own for what is seen from frame to frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import Field

from common.config import Parameters, Tunable

Place = tuple[float, float, float]


class SceneParameters(Parameters):
    """How detections become objects; times are cell time."""

    match_radius: Tunable[float] = Field(
        0.08, gt=0, le=0.5, description="a detection within this of a ball is that ball [m]"
    )
    confirm_frames: Tunable[int] = Field(
        2, ge=1, le=100, description="a ball exists once it was seen in this many frames"
    )
    forget_after: Tunable[float] = Field(0.35, ge=0, le=60, description="a ball not seen for this long is gone [s]")
    smoothing: Tunable[float] = Field(
        0.3, gt=0, le=1, description="weight of a new detection of a ball that lies still"
    )
    still: Tunable[float] = Field(0.003, ge=0, le=0.05, description="displacement below which a ball lies still [m]")


@dataclass
class Track:
    """One ball: where it was seen last [m], in world, how often, and when [s]."""

    id: str
    position: Place
    seen: int
    last_seen: float


class Tracks:
    """Matches detections to known balls, one to one, nearest pairs first."""

    def __init__(self, parameters: SceneParameters) -> None:
        """Start with no balls; the parameters may change between frames."""
        self.p = parameters
        self._tracks: list[Track] = []
        self._count = 0

    def update(self, positions: Sequence[Place], now: float) -> None:
        """Take in all detections of one frame, taken at `now` [s]."""
        pairs = sorted(
            (math.dist(t.position, p), i, j)
            for i, t in enumerate(self._tracks)
            for j, p in enumerate(positions)
            if math.dist(t.position, p) <= self.p.match_radius
        )
        matched_tracks: set[int] = set()
        matched: set[int] = set()
        for distance, i, j in pairs:
            if i in matched_tracks or j in matched:
                continue
            matched_tracks.add(i)
            matched.add(j)
            track, weight = self._tracks[i], self.p.smoothing if distance < self.p.still else 1.0
            x, y, z = (a + weight * (b - a) for a, b in zip(track.position, positions[j], strict=True))
            track.position, track.seen, track.last_seen = (x, y, z), track.seen + 1, now
        self._tracks = [t for t in self._tracks if now - t.last_seen <= self.p.forget_after]
        for j, position in enumerate(positions):
            if j not in matched:
                self._count += 1
                self._tracks.append(Track(f"track_{self._count}", position, 1, now))

    def confirmed(self) -> list[Track]:
        """Balls that were seen often enough to be believed."""
        return [t for t in self._tracks if t.seen >= self.p.confirm_frames]

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
