"""Track detected objects over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from pydantic import Field

from common.config import Parameters, Tunable
from common.messages import Color, Marker, Quaternion
from common.perception.moving import Encoders, MovingEstimate

Place = tuple[float, float, float]
Shape = Literal["sphere", "box", "cylinder"]
Hides = Callable[[Place], bool]  # whether a position is occluded in an image

AHEAD = 5.0  # [s] detections this far ahead of a frame have a wrong clock
MOST = 200  # tracked objects; with those derived from them, a planning scene has little more room
WIDTH_SLACK = 0.01  # [m] tolerated difference between finger width and detected size of a held object


class SceneParameters(Parameters):
    """How detections become objects; times are cell time."""

    match_radius: Tunable[float] = Field(
        0.08, gt=0, le=0.5, description="a detection of its kind within this of an object is that object [m]"
    )
    confirm_frames: Tunable[int] = Field(
        2, ge=1, le=100, description="an object exists once it was seen in this many frames"
    )
    forget_after: Tunable[float] = Field(0.35, ge=0, le=60, description="an object not seen for this long is gone [s]")
    smoothing: Tunable[float] = Field(
        0.3, gt=0, le=1, description="weight of a new detection of an object that lies still"
    )
    still: Tunable[float] = Field(0.003, ge=0, le=0.05, description="displacement below which an object lies still [m]")


@dataclass(frozen=True)
class Sighting:
    """One detection of an object: position [m] in world, kind, shape, size and color.

    `size` is that of its bounding box along its own axes [m].
    """

    position: Place
    kind: str = ""
    shape: Shape = "sphere"
    size: Place = (0.0, 0.0, 0.0)
    orientation: Quaternion = field(default_factory=Quaternion)
    color: Color = field(default_factory=Color)

    @classmethod
    def of(cls, marker: Marker) -> Sighting | None:
        """Convert a marker; None for text and for markers without a size."""
        p, s = marker.pose.position, marker.scale
        if marker.type == "text" or min(s.x, s.y, s.z) <= 0:
            return None
        return cls((p.x, p.y, p.z), marker.ns, marker.type, (s.x, s.y, s.z), marker.pose.orientation, marker.color)

    @property
    def dimensions(self) -> list[float]:
        """Dimensions as in a planning scene: box x, y, z; sphere radius; cylinder radius and length."""
        x, y, z = self.size
        return {"sphere": [x / 2], "cylinder": [x / 2, z], "box": [x, y, z]}[self.shape]

    def across(self, width: float, slack: float) -> bool:
        """Return whether fingers that hold it may have this width [m]."""
        x, y, _ = self.size
        least, most = (min(x, y), math.hypot(x, y)) if self.shape == "box" else (x, x)
        return least - slack <= width <= most + slack


@dataclass
class Track:
    """One object: position in world [m], number of detections, time [s], view and content of the last one."""

    id: str
    position: Place
    seen: int
    last_seen: float
    sighting: Sighting = Sighting((0.0, 0.0, 0.0))
    view: int = 0
    before: float = 0.0  # time of the view's frame before the first detection [s]
    velocity: Place = (0.0, 0.0, 0.0)  # [m/s]
    motion: MovingEstimate | None = None  # in a cell with belts

    def move_to(self, now: float) -> None:
        """Update position and velocity of an object that moves to a time [s]."""
        if self.motion is not None:
            position, velocity = self.motion.at(now)
            (x, y, z), (vx, vy, vz) = position.tolist(), velocity.tolist()
            self.position, self.velocity = (x, y, z), (vx, vy, vz)


class Tracks:
    """Matches detections to known objects of the same kind, one to one, nearest pairs first."""

    def __init__(self, parameters: SceneParameters, encoders: Encoders | None = None) -> None:
        """Start without objects; the parameters may change between frames. With belts, objects may move."""
        self.p, self._encoders = parameters, encoders
        self._tracks: list[Track] = []
        self._count = 0
        self.crowded = False  # whether the last frame had more objects than fit
        self._newest: dict[int, float] = {}  # last frame of each view [s]
        self._looked: dict[int, float] = {}  # last frame of cameras that look at times [s]
        self._hides: dict[int, tuple[float, Hides | None]] = {}  # of other cameras: last frame [s], its occlusion

    def update(
        self, sightings: Sequence[Sighting], now: float, view: int = 0, at_times: bool = False,
        hides: Hides | None = None,
    ) -> None:
        """Process all detections of one frame.

        Args:
            sightings: of the frame.
            now: when it was taken [s].
            view: number of the view.
            at_times: the view looks at times only: its objects stay known until it looks again.
            hides: which positions are occluded in the frame: objects there stay known.
        """
        if at_times:
            self._looked[view] = now
        else:
            self._hides[view] = now, hides
        self.move_to(now)
        pairs = sorted(
            (math.dist(t.position, s.position), i, j)
            for i, t in enumerate(self._tracks)
            for j, s in enumerate(sightings)
            if math.dist(t.position, s.position) <= self.p.match_radius
            and (t.sighting.kind, t.sighting.shape) == (s.kind, s.shape)
        )
        matched_tracks: set[int] = set()
        matched: set[int] = set()
        for distance, i, j in pairs:
            if i in matched_tracks or j in matched:
                continue
            matched_tracks.add(i)
            matched.add(j)
            track, weight = self._tracks[i], self.p.smoothing if distance < self.p.still else 1.0
            x, y, z = (a + weight * (b - a) for a, b in zip(track.position, sightings[j].position, strict=True))
            track.position, track.seen, track.last_seen = (x, y, z), track.seen + 1, now
            track.sighting, track.view = sightings[j], view
            self._estimate(track, now)
        for track in self._tracks:
            if track.last_seen < now and track.seen >= self.p.confirm_frames and self._is_hidden(track, now):
                track.last_seen = now
        self._tracks = [t for t in self._tracks if -AHEAD <= self._unseen_for(t, now) <= self.p.forget_after]
        new = [sighting for j, sighting in enumerate(sightings) if j not in matched]
        room = MOST - len(self._tracks)
        self.crowded = len(new) > room
        before, self._newest[view] = self._newest.get(view, 0.0), now
        for sighting in new[: max(room, 0)]:
            self._count += 1
            self._tracks.append(Track(f"track_{self._count}", sighting.position, 1, now, sighting, view, before))
            self._estimate(self._tracks[-1], now)

    def _estimate(self, track: Track, now: float) -> None:
        """Update the motion of an object that was just detected."""
        if self._encoders is not None:
            track.motion = track.motion or MovingEstimate(self._encoders)
            track.motion.add(now, track.sighting.position, track.sighting.size[2])
            track.move_to(now)

    def move_to(self, now: float) -> None:
        """Update the positions of objects that move to a time [s]."""
        for track in self._tracks:
            track.move_to(now)

    def _is_hidden(self, track: Track, now: float) -> bool:
        """Return whether its position is occluded in all current views."""
        looking = [hides for at, hides in self._hides.values() if now - at <= self.p.forget_after]
        return bool(looking) and all(hides is not None and hides(track.position) for hides in looking)

    def _unseen_for(self, track: Track, now: float) -> float:
        """Return for how long the views that could see it have not detected it [s]."""
        return self._looked.get(track.view, now) - track.last_seen

    def confirmed(self) -> list[Track]:
        """Return the objects detected often enough to be published."""
        return [t for t in self._tracks if t.seen >= self.p.confirm_frames]

    def settled(self) -> float | None:
        """Return the time of the newest frame without unconfirmed objects [s]; None: the newest one of all has none."""
        return min((t.before for t in self._tracks
                    if t.seen < self.p.confirm_frames and t.last_seen >= self._newest.get(t.view, 0.0)), default=None)

    def take(self, position: Place, radius: float, width: float = 0.0) -> Track | None:
        """Remove and return the object nearest to a position, within `radius` [m].

        Objects that fit between fingers of this `width` [m] are preferred.
        """
        within = [t for t in self._tracks if math.dist(t.position, position) <= radius]
        fitting = [t for t in within if t.sighting.across(width, WIDTH_SLACK)] if width > 0 else []
        near = min(fitting or within, key=lambda t: math.dist(t.position, position), default=None)
        if near is None:
            return None
        self._tracks.remove(near)
        return near

    def new_id(self) -> str:
        """Return an id for an object that was never detected on the table."""
        self._count += 1
        return f"track_{self._count}"
