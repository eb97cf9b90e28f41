"""Track detected objects over time and publish them as a planning scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from applications.pick_place.ball_places import Resting
from common import messages as m
from common.config import GripperConfig, Parameters, Surroundings, Tunable
from common.messages import Color, Marker, Quaternion
from common.perception.occlusion import Occlusion
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix
from common.scene.fixtures import color_of, fixed_objects
from common.scene.slots import occupied_slots, slot_positions

Place = tuple[float, float, float]
Shape = Literal["sphere", "box", "cylinder"]
Hides = Callable[[Place], bool]  # whether a place cannot be judged in a picture

AHEAD = 5.0  # [s] what was seen later than that after a frame was told of by a clock that is wrong
MOST = 200  # objects that are tracked: with what is made of them, a planning scene has room for few more
WIDTH_SLACK = 0.01  # [m] by which the fingers' width and the seen size of what they hold may differ


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
    """What one detection says of an object: where it is [m], world, what it is, and how large and of which colour.

    `size` is that of the box about it along its own axes [m].
    """

    position: Place
    kind: str = ""
    shape: Shape = "sphere"
    size: Place = (0.0, 0.0, 0.0)
    orientation: Quaternion = field(default_factory=Quaternion)
    color: Color = field(default_factory=Color)

    @classmethod
    def of(cls, marker: Marker) -> Sighting | None:
        """What a marker says; None for one that is no object: words, and what has no size."""
        p, s = marker.pose.position, marker.scale
        if marker.type == "text" or min(s.x, s.y, s.z) <= 0:
            return None
        return cls((p.x, p.y, p.z), marker.ns, marker.type, (s.x, s.y, s.z), marker.pose.orientation, marker.color)

    @property
    def dimensions(self) -> list[float]:
        """As a planning scene has them: of a box x, y, z, of a sphere its radius, of a cylinder radius and length."""
        x, y, z = self.size
        return {"sphere": [x / 2], "cylinder": [x / 2, z], "box": [x, y, z]}[self.shape]

    def across(self, width: float, slack: float) -> bool:
        """Whether fingers that hold it may be so far apart [m]."""
        x, y, _ = self.size
        least, most = (min(x, y), math.hypot(x, y)) if self.shape == "box" else (x, x)
        return least - slack <= width <= most + slack


@dataclass
class Track:
    """One object: where it is, in world [m], how often it was seen, when last [s] and in which view, and what then."""

    id: str
    position: Place
    seen: int
    last_seen: float
    sighting: Sighting = Sighting((0.0, 0.0, 0.0))
    view: int = 0


class Tracks:
    """Matches detections to known objects of their kind, one to one, nearest pairs first."""

    def __init__(self, parameters: SceneParameters) -> None:
        """Start with no objects; the parameters may change between frames."""
        self.p = parameters
        self._tracks: list[Track] = []
        self._count = 0
        self.crowded = False  # whether something of the last frame found no room
        self._looked: dict[int, float] = {}  # of views that look at times: when last [s]
        self._hides: dict[int, tuple[float, Hides | None]] = {}  # of the others: when they looked last [s], what hides

    def update(
        self, sightings: Sequence[Sighting], now: float, view: int = 0, at_times: bool = False,
        hides: Hides | None = None,
    ) -> None:
        """Take in all detections of one frame.

        Args:
            sightings: of the frame.
            now: when it was taken [s].
            view: which of several views it is of.
            at_times: that one looks at times only: what it showed is known until it looks again.
            hides: what of the frame cannot be judged: what was known there is known as long as nobody sees the place.
        """
        if at_times:
            self._looked[view] = now
        else:
            self._hides[view] = now, hides
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
        for track in self._tracks:
            if track.last_seen < now and track.seen >= self.p.confirm_frames and self._is_hidden(track, now):
                track.last_seen = now
        self._tracks = [t for t in self._tracks if -AHEAD <= self._unseen_for(t, now) <= self.p.forget_after]
        new = [sighting for j, sighting in enumerate(sightings) if j not in matched]
        room = MOST - len(self._tracks)
        self.crowded = len(new) > room
        for sighting in new[: max(room, 0)]:
            self._count += 1
            self._tracks.append(Track(f"track_{self._count}", sighting.position, 1, now, sighting, view))

    def _is_hidden(self, track: Track, now: float) -> bool:
        """Whether nobody who looks now can tell whether it is there."""
        looking = [hides for at, hides in self._hides.values() if now - at <= self.p.forget_after]
        return bool(looking) and all(hides is not None and hides(track.position) for hides in looking)

    def _unseen_for(self, track: Track, now: float) -> float:
        """For how long nobody has seen it who looked [s]."""
        return self._looked.get(track.view, now) - track.last_seen

    def confirmed(self) -> list[Track]:
        """Objects that were seen often enough to be believed."""
        return [t for t in self._tracks if t.seen >= self.p.confirm_frames]

    def take(self, position: Place, radius: float, width: float = 0.0) -> Track | None:
        """The object nearest to a position, within `radius` [m], which is no longer tracked after this.

        One that fits between fingers which are `width` [m] apart, if they tell that and there is one.
        """
        within = [t for t in self._tracks if math.dist(t.position, position) <= radius]
        fitting = [t for t in within if t.sighting.across(width, WIDTH_SLACK)] if width > 0 else []
        near = min(fitting or within, key=lambda t: math.dist(t.position, position), default=None)
        if near is None:
            return None
        self._tracks.remove(near)
        return near

    def new_id(self) -> str:
        """An id for an object that was never seen on the table."""
        self._count += 1
        return f"track_{self._count}"


Array = NDArray[np.float64]

GREY = m.Color(r=0.6, g=0.6, b=0.6)  # of what is not seen
LEVEL = 0.005  # [m] what is seen so little above the table lies on it
MOST_BESIDE = 50  # objects in containers that are in no slot
AT_REST = 0.5  # [s] for which something is seen in a slot before it is taken to lie there


@dataclass
class Occupied:
    """Slots in which a view showed something at a stamp [ns], and those beneath that it could not show."""

    stamp: int
    seen: set[int]
    beneath: set[int]


class PerceivedScene:
    """Keeps what was seen and felt, and says it as a planning scene."""

    def __init__(
        self, parameters: SceneParameters, around: Surroundings, gripper: GripperConfig, tcp_link: str
    ) -> None:
        """Start with the fixtures alone.

        Args:
            parameters: of the tracking; they may change meanwhile.
            around: fixtures, containers, and how large balls are, of which the first container has slots.
            gripper: its links may touch what is held.
            tcp_link: what is held moves with this link.
        """
        self.around, self.gripper, self.tcp_link = around, gripper, tcp_link
        self.p, self._tracks = parameters, Tracks(parameters)
        self._fixed = fixed_objects(around)
        self._resting = [replace(Resting.of(around), container=box) for box in around.containers.values()]
        self._with_slots = next((box.container for box in self._resting), None)
        self._slots = slot_positions(around.container, around.ball_radius, around.table_height).reshape(-1, 3)
        self._in_slots = [
            self._ball(f"slot_{k}", "contained", m.Pose(position=m.Vector3(x=x, y=y, z=z)))
            for k, (x, y, z) in enumerate(self._slots.tolist(), 1)
        ]
        self._occupied: dict[int, Occupied] = {}  # by view
        self._lasts: set[int] = set()  # views that look at times
        self._free: set[int] = set()  # slots in which nothing was when the hand took something, nor came to rest since
        self._since: dict[int, int] = {}  # stamp since which something is seen in a slot
        self._beside_slots: dict[int, list[Sighting]] = {}  # what else lies in the container, by view
        self._held: m.AttachedObject | None = None
        self._changed_hands_at = 0
        self._stamp = 0

    def see(self, detections: m.MarkerArray, camera: Pinhole, T_world_tcp: Array | None, view: int = 0,
            at_times: bool = False, hidden: Occlusion | None = None) -> None:
        """Take in the detections of one frame, of one of several views.

        A frame that was taken before the hand last closed or opened still shows what is in the hand now on the table:
        it is left out. So is anything seen where the hand holds a ball. What a camera showed that looks `at_times` is
        known until it looks again; what is `hidden` in the picture, until somebody sees that place.
        """
        stamp = detections.header.stamp
        if stamp <= self._changed_hands_at:
            return
        self._stamp = max(self._stamp, stamp)
        hand = None
        if self._held is not None and T_world_tcp is not None:
            hand = tuple(T_world_tcp[:3, 3])
        on_table: list[Sighting] = []
        beside_slots: list[Sighting] = []
        in_container: list[tuple[float, float]] = []
        for marker in detections.markers:
            thing = Sighting.of(marker)
            if thing is None:
                continue
            pixel = marker.pixel or tuple(camera.project(list(thing.position)))
            shown = [box for box in self._resting if box.shows_container(camera, pixel)]
            if shown and thing.shape == "sphere" and shown[0].container is self._with_slots:
                in_container.append((pixel[0], pixel[1]))
            elif shown:
                beside_slots.append(thing)
            elif hand is None or math.dist(hand, thing.position) > max(thing.size) / 2:
                on_table.append(thing)
        radius = self.around.ball_radius
        self._tracks.update(on_table, stamp * 1e-9, view, at_times, None if hidden is None else (
            lambda place: bool(hidden.hides([place], radius)[0])))
        now = Occupied(stamp, *occupied_slots(in_container, camera, self._slots, radius, self._free))
        if hidden is None:
            self._beside_slots[view] = beside_slots
        else:
            self._keep_hidden(view, now, hidden)
            if beside_slots or not hidden.everything:
                self._beside_slots[view] = beside_slots
        self._occupied[view] = now
        self._since = {slot: self._since.get(slot, stamp) for slot in self._occupied_slots(beneath=False)}
        # What falls and rolls is seen in one slot after the other, and is in none of them when the next covers it.
        self._free -= {slot for slot, since in self._since.items() if (stamp - since) * 1e-9 >= AT_REST}
        if at_times:
            self._lasts.add(view)

    def _keep_hidden(self, view: int, now: Occupied, hidden: Occlusion) -> None:
        """Slots in which something was and which cannot be judged now stay as they were."""
        before = self._occupied.get(view)
        slots = sorted((before.seen | before.beneath) - now.seen - now.beneath) if before else []
        if not before or not slots:
            return
        behind = hidden.hides(self._slots[slots], self.around.ball_radius)
        kept = {slot for slot, away in zip(slots, behind, strict=True) if away}
        now.seen |= kept & before.seen
        now.beneath |= kept - before.seen

    def feel(self, gripper: m.GripperState, T_world_tcp: Array | None) -> None:
        """Take in whether the hand holds something: the nearest ball moves into it with its id, or leaves it."""
        if gripper.holding == (self._held is not None) or (gripper.holding and T_world_tcp is None):
            return
        self._changed_hands_at = gripper.header.stamp
        if not gripper.holding or T_world_tcp is None:
            self._held = None
            return
        # What was let go may be seen while it still hangs or falls, as high as if it lay on another one. One ball more
        # has come into the container then, not two. Before the first picture nothing is known to be free.
        self._free = set(range(len(self._slots))) - self._occupied_slots() if self._occupied else set()
        x, y, z = (float(v) for v in T_world_tcp[:3, 3])
        track = self._tracks.take((x, y, z), self.p.match_radius, gripper.width if self.gripper.cup is None else 0.0)
        # The fingers have centred it between them; along them and along the tool it lies where it was seen.
        offset = np.zeros(3)
        if track is not None:
            offset = (invert(T_world_tcp) @ np.array([*track.position, 1.0]))[:3]
            # A cup holds it as it lay, by its top.
            below = np.zeros(3)
            if self.gripper.cup is not None:
                below[2] = track.position[2] - self.around.table_height
            else:
                offset["xy".index(self.gripper.closing_axis)] = 0.0
            offset = below + np.clip(offset - below, -0.015, 0.015)
        T_tcp_object = np.eye(4)
        T_tcp_object[:3, 3] = offset
        if track is not None and track.sighting.shape != "sphere":
            T_tcp_object[:3, :3] = T_world_tcp[:3, :3].T @ pose_to_matrix(_pose(track))[:3, :3]
        pose = matrix_to_pose(T_tcp_object)
        thing = self._object(track.id, "attached", track.sighting, pose) if track else self._ball(
            self._tracks.new_id(), "attached", pose)
        self._held = m.AttachedObject(link=self.tcp_link, object=thing)

    @property
    def crowded(self) -> bool:
        """Whether more was seen than a planning scene has room for: then it does not hold all."""
        return self._tracks.crowded or any(len(things) > MOST_BESIDE for things in self._beside_slots.values())

    def scene(self) -> m.PlanningScene:
        """What is believed now; its stamp is that of the newest frame in it."""
        table = [self._object(t.id, "target", t.sighting, _pose(t)) for t in self._tracks.confirmed()]
        seen = self._occupied_slots(beneath=False)
        contained = [self._in_slots[k] if k in seen else self._in_slots[k].model_copy(update={"unseen": True})
                     for k in sorted(self._occupied_slots())]
        beside: list[Sighting] = []
        for things in self._beside_slots.values():
            beside = things if len(things) > len(beside) else beside
        contained += [  # as the view has it that shows most of them
            self._object(f"contained_{k + 1}", "contained", thing, _pose(Track("", thing.position, 0, 0.0, thing)))
            for k, thing in enumerate(beside[:MOST_BESIDE])
        ]
        held = [self._held] if self._held is not None else []
        return m.PlanningScene(
            header=m.Header(stamp=self._stamp, frame_id="world"),
            objects=[*self._fixed, *table, *contained, *self._below(table)],
            attached=held,
            allowed_collisions=[(link, h.object.id) for h in held for link in self.gripper.links],
        )

    def _below(self, table: list[m.CollisionObject]) -> list[m.CollisionObject]:
        """Columns under what stands above the table: something carries it, though a camera above sees none of that."""
        columns = []
        for thing in table:
            gap = thing.pose.position.z - thing.dimensions[-1] / 2 - self.around.table_height
            if thing.shape != "sphere" and gap > LEVEL:
                at = m.Vector3(x=thing.pose.position.x, y=thing.pose.position.y, z=self.around.table_height + gap / 2)
                pose = thing.pose.model_copy(update={"position": at})
                columns.append(thing.model_copy(update={
                    "id": f"below_{thing.id}", "role": "fixture", "kind": "", "pose": pose, "mass": 0.0, "color": GREY,
                    "dimensions": [*thing.dimensions[:-1], gap]}))
        return columns

    def _occupied_slots(self, *, beneath: bool = True) -> set[int]:
        """Slots in which any view shows something now, with those that have to carry it or without."""
        return {slot for view, one in self._occupied.items() for slot in one.seen | (one.beneath if beneath else set())
                if view in self._lasts or (self._stamp - one.stamp) * 1e-9 <= self.p.forget_after}

    def _ball(self, name: str, role: str, pose: m.Pose) -> m.CollisionObject:
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": "sphere", "dimensions": [self.around.ball_radius], "pose": pose,
            "color": color_of(self.around.ball_color),
        })

    def _object(self, name: str, role: str, thing: Sighting, pose: m.Pose) -> m.CollisionObject:
        """A solid of the planning scene, with shape, size and colour as they were seen."""
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": thing.shape, "dimensions": thing.dimensions, "pose": pose,
            "color": thing.color, "grip_effort": self.around.grip_efforts.get(thing.kind, 0.0),
            "mass": self.around.masses.get(thing.kind, 0.0), "kind": thing.kind,
        })


def _pose(track: Track) -> m.Pose:
    x, y, z = track.position
    return m.Pose(position=m.Vector3(x=x, y=y, z=z), orientation=track.sighting.orientation)
