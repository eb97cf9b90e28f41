"""Track detected objects over time and publish them as a planning scene."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from applications.pick_place.ball_places import BallGeometry
from common import messages as m
from common.config import GripperConfig, Parameters, Surroundings, Tunable
from common.messages import Color, Marker, Quaternion
from common.perception.occlusion import Occlusion
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix
from common.scene.fixtures import color_of, fixed_objects, occupied_slots, slot_positions

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


class Tracks:
    """Matches detections to known objects of the same kind, one to one, nearest pairs first."""

    def __init__(self, parameters: SceneParameters) -> None:
        """Start without objects; the parameters may change between frames."""
        self.p = parameters
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
        before, self._newest[view] = self._newest.get(view, 0.0), now
        for sighting in new[: max(room, 0)]:
            self._count += 1
            self._tracks.append(Track(f"track_{self._count}", sighting.position, 1, now, sighting, view, before))

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


Array = NDArray[np.float64]

GREY = m.Color(r=0.6, g=0.6, b=0.6)  # color of what is not seen
LEVEL = 0.005  # [m] an object this little above the table lies on it
MAX_UNSORTED = 50  # objects in containers but in no slot
MOST_BELOW = 0.015  # [m] below the tool, of a held object of unknown size: it may be as close to a table as it likes
LEAST_SIZE = 1e-3  # [m]
AT_REST = 0.5  # [s] for which a slot must look occupied before the object counts as at rest


@dataclass
class Occupied:
    """Slots that a view shows occupied at a stamp [ns], and slots below them that it cannot see."""

    stamp: int
    seen: set[int]
    beneath: set[int]


class PerceivedScene:
    """Combines detections and gripper states into a planning scene."""

    def __init__(
        self, parameters: SceneParameters, around: Surroundings, gripper: GripperConfig, tcp_link: str
    ) -> None:
        """Start with the fixtures alone.

        Args:
            parameters: of the tracking; they may change at runtime.
            around: fixtures, containers, and the radius of balls; the first container has slots for them.
            gripper: its links may touch the held object.
            tcp_link: link that the held object moves with.
        """
        self.around, self.gripper, self.tcp_link = around, gripper, tcp_link
        self.p, self._tracks = parameters, Tracks(parameters)
        self._fixed = fixed_objects(around)
        self._resting = [replace(BallGeometry.of(around), container=box) for box in around.containers.values()]
        self._with_slots = next((box.container for box in self._resting), None)
        self._slots = slot_positions(around.container, around.ball_radius, around.table_height).reshape(-1, 3)
        self._in_slots = [
            self._ball(f"slot_{k}", "contained", m.Pose(position=m.Vector3(x=x, y=y, z=z)))
            for k, (x, y, z) in enumerate(self._slots.tolist(), 1)
        ]
        self._occupied: dict[int, Occupied] = {}  # by view
        self._occasional_views: set[int] = set()  # views that look at times
        self._free: set[int] = set()  # slots empty at the last grasp, without an object at rest since
        self._since: dict[int, int] = {}  # stamp since which a slot looks occupied
        self._unsorted: dict[int, list[Sighting]] = {}  # other objects in containers, by view
        self._undetected_width: float | None = None  # of a held object that no detector reported [m]
        self._has_balls = False  # whether a detector reported any
        self._held: m.AttachedObject | None = None
        self._changed_hands_at = 0
        self._stamp = 0

    def update_detections(self, detections: m.MarkerArray, camera: Pinhole, T_world_tcp: Array | None, view: int = 0,
            at_times: bool = False, hidden: Occlusion | None = None) -> None:
        """Process the detections of one frame of one view.

        Frames taken before the last gripper change still show the held object on the table and are skipped. Detections
        at the held object are ignored. Objects of a view that looks `at_times` stay known until it looks again; objects
        in the `hidden` part of an image until a view shows their positions.
        """
        stamp = detections.header.stamp
        if stamp <= self._changed_hands_at:
            return
        self._stamp = max(self._stamp, stamp)
        hand = None
        if self._held is not None and T_world_tcp is not None:
            hand = tuple(T_world_tcp[:3, 3])
        on_table: list[Sighting] = []
        unsorted: list[Sighting] = []
        in_container: list[tuple[float, float]] = []
        for marker in detections.markers:
            thing = Sighting.of(marker)
            if thing is None:
                continue
            if thing.shape == "sphere" and not self._has_balls:
                self._has_balls = True
                if self._held is not None and self._undetected_width is not None:  # it may be one, too
                    held = self._undetected(self._held.object.id, self._undetected_width)
                    self._held = self._held.model_copy(update={"object": held})
            pixel = marker.pixel or tuple(camera.project(list(thing.position)))
            shown = [box for box in self._resting if box.shows_container(camera, pixel)]
            if shown and thing.shape == "sphere" and shown[0].container is self._with_slots:
                in_container.append((pixel[0], pixel[1]))
            elif shown:
                unsorted.append(thing)
            elif hand is None or math.dist(hand, thing.position) > max(thing.size) / 2:
                on_table.append(thing)
        radius = self.around.ball_radius
        self._tracks.update(on_table, stamp * 1e-9, view, at_times, None if hidden is None else (
            lambda place: bool(hidden.occludes([place], radius)[0])))
        now = Occupied(stamp, *occupied_slots(in_container, camera, self._slots, radius, self._free))
        if hidden is None:
            self._unsorted[view] = unsorted
        else:
            self._retain_occluded(view, now, hidden)
            if unsorted or not hidden.covers_image:
                self._unsorted[view] = unsorted
        self._occupied[view] = now
        self._since = {slot: self._since.get(slot, stamp) for slot in self._occupied_slots(beneath=False)}
        # A falling or rolling object appears in one slot after another, and in none of them once another covers it.
        self._free -= {slot for slot, since in self._since.items() if (stamp - since) * 1e-9 >= AT_REST}
        if at_times:
            self._occasional_views.add(view)

    def _retain_occluded(self, view: int, now: Occupied, hidden: Occlusion) -> None:
        """Keep the state of occupied slots that are occluded now."""
        before = self._occupied.get(view)
        slots = sorted((before.seen | before.beneath) - now.seen - now.beneath) if before else []
        if not before or not slots:
            return
        behind = hidden.occludes(self._slots[slots], self.around.ball_radius)
        occluded = {slot for slot, away in zip(slots, behind, strict=True) if away}
        now.seen |= occluded & before.seen
        now.beneath |= occluded - before.seen

    def update_gripper(self, gripper: m.GripperState, T_world_tcp: Array | None) -> None:
        """Process a change of the gripper: the nearest object becomes the held one with its id, or it is released."""
        if gripper.holding == (self._held is not None) or (gripper.holding and T_world_tcp is None):
            return
        self._changed_hands_at = gripper.header.stamp
        if not gripper.holding or T_world_tcp is None:
            self._held = None
            return
        # A released object may be seen while it falls, as high as if it lay on another one. It is one more object in
        # the container then, not two. Before the first image no slot is known to be free.
        self._free = set(range(len(self._slots))) - self._occupied_slots() if self._occupied else set()
        x, y, z = (float(v) for v in T_world_tcp[:3, 3])
        track = self._tracks.take((x, y, z), self.p.match_radius, gripper.width if self.gripper.cup is None else 0.0)
        # The fingers centered it between them; along the fingers and along the tool it is where it was detected.
        offset = np.zeros(3)
        if track is not None:
            offset = (invert(T_world_tcp) @ np.array([*track.position, 1.0]))[:3]
            # A cup holds it by its top, where it was.
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
        thing = self._object(track.id, "attached", track.sighting, pose) if track else self._undetected(
            self._tracks.new_id(), gripper.width)
        self._undetected_width = None if track else gripper.width
        self._held = m.AttachedObject(link=self.tcp_link, object=thing)

    def _undetected(self, name: str, width: float) -> m.CollisionObject:
        """Return a held object that no camera reported: the fingers measure its width [m], nothing its other sizes."""
        cup = self.gripper.cup
        if cup is None and self._has_balls and abs(width - 2 * self.around.ball_radius) <= WIDTH_SLACK:
            return self._ball(name, "attached", m.Pose())
        size = 2 * min(MOST_BELOW, self.gripper.fingers.half_width if cup is None else cup.lip_radius)
        across = size if cup is not None else max(width, LEAST_SIZE)
        dimensions = [across, size, size] if self.gripper.closing_axis == "x" else [size, across, size]
        return m.CollisionObject.model_validate({
            "id": name, "role": "attached", "shape": "box", "dimensions": dimensions, "color": GREY,
            "pose": m.Pose(position=m.Vector3(z=0.0 if cup is None else size / 2))})

    @property
    def crowded(self) -> bool:
        """Whether more was detected than a planning scene can hold."""
        return self._tracks.crowded or any(len(things) > MAX_UNSORTED for things in self._unsorted.values())

    def scene(self) -> m.PlanningScene:
        """Return the planning scene; its stamp is that of its newest frame."""
        table = [self._object(t.id, "target", t.sighting, _pose(t)) for t in self._tracks.confirmed()]
        seen = self._occupied_slots(beneath=False)
        contained = [self._in_slots[k] if k in seen else self._in_slots[k].model_copy(update={"unseen": True})
                     for k in sorted(self._occupied_slots())]
        unsorted: list[Sighting] = []
        for things in self._unsorted.values():
            unsorted = things if len(things) > len(unsorted) else unsorted
        contained += [  # of the view that shows most of them
            self._object(f"contained_{k + 1}", "contained", thing, _pose(Track("", thing.position, 0, 0.0, thing)))
            for k, thing in enumerate(unsorted[:MAX_UNSORTED])
        ]
        held = [self._held] if self._held is not None else []
        settled = self._tracks.settled()
        return m.PlanningScene(
            header=m.Header(stamp=self._stamp, frame_id="world"),
            settled=None if settled is None else round(settled * 1e9),
            objects=[*self._fixed, *table, *contained, *self._below(table)],
            attached=held,
            allowed_collisions=[(link, h.object.id) for h in held for link in self.gripper.links],
        )

    def _below(self, table: list[m.CollisionObject]) -> list[m.CollisionObject]:
        """Return columns below objects above the table: something supports them, invisible to a camera above."""
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
        """Return the slots that any current view shows occupied, with or without the ones below that carry them."""
        return {slot for view, one in self._occupied.items() for slot in one.seen | (one.beneath if beneath else set())
                if view in self._occasional_views or (self._stamp - one.stamp) * 1e-9 <= self.p.forget_after}

    def _ball(self, name: str, role: str, pose: m.Pose) -> m.CollisionObject:
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": "sphere", "dimensions": [self.around.ball_radius], "pose": pose,
            "color": color_of(self.around.ball_color),
        })

    def _object(self, name: str, role: str, thing: Sighting, pose: m.Pose) -> m.CollisionObject:
        """Return an object of the planning scene with the detected shape, size and color."""
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": thing.shape, "dimensions": thing.dimensions, "pose": pose,
            "color": thing.color, "grip_effort": self.around.grip_efforts.get(thing.kind, 0.0),
            "mass": self.around.masses.get(thing.kind, 0.0), "kind": thing.kind,
        })


def _pose(track: Track) -> m.Pose:
    x, y, z = track.position
    return m.Pose(position=m.Vector3(x=x, y=y, z=z), orientation=track.sighting.orientation)
