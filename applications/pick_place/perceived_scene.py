"""Publish tracked objects, and what the gripper holds, as a planning scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from applications.pick_place.ball_places import BallGeometry
from applications.pick_place.tracks import WIDTH_SLACK, SceneParameters, Sighting, Track, Tracks
from common import messages as m
from common.config import GripperConfig, Surroundings
from common.perception.moving import Encoders
from common.perception.occlusion import Occlusion
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix
from common.scene.fixtures import color_of, fixed_objects, occupied_slots, slot_positions
from common.tasks.stages import place_of

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
        self, parameters: SceneParameters, around: Surroundings, gripper: GripperConfig, tcp_link: str,
        encoders: Encoders | None = None,
    ) -> None:
        """Start with the fixtures alone.

        Args:
            parameters: of the tracking; they may change at runtime.
            around: fixtures, containers, and the radius of balls; the first container has slots for them.
            gripper: its links may touch the held object.
            tcp_link: link that the held object moves with.
            encoders: of the belts of a cell with conveyors.
        """
        self.around, self.gripper, self.tcp_link = around, gripper, tcp_link
        self.p, self._tracks = parameters, Tracks(parameters, encoders)
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
        self.held: m.AttachedObject | None = None  # by the gripper
        self.held_by_others: list[m.CollisionObject] = []  # by other arms of the cell, in world
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
        if self.held is not None and T_world_tcp is not None:
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
                if self.held is not None and self._undetected_width is not None:  # it may be one, too
                    held = self._undetected(self.held.object.id, self._undetected_width)
                    self.held = self.held.model_copy(update={"object": held})
            pixel = marker.pixel or tuple(camera.project(list(thing.position)))
            shown = [box for box in self._resting if box.shows_container(camera, pixel)]
            if shown and thing.shape == "sphere" and shown[0].container is self._with_slots:
                in_container.append((pixel[0], pixel[1]))
            elif shown:
                if shown[0].container.id not in self.around.filled_by_others:
                    unsorted.append(thing)
            elif not self._is_in_a_hand(thing, hand):
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

    def _is_in_a_hand(self, thing: Sighting, hand: tuple[float, ...] | None) -> bool:
        held = [place_of(other.pose) for other in self.held_by_others]
        return (hand is not None and math.dist(hand, thing.position) <= max(thing.size) / 2) or any(
            math.dist(place, thing.position) <= max(thing.size) for place in held)

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
        if self.held is not None and self._undetected_width is not None and gripper.holding and (
                T_world_tcp is not None) and (other := self._handed_over(T_world_tcp)) is not None:
            self._know(other)
        if gripper.holding == (self.held is not None) or (gripper.holding and T_world_tcp is None):
            return
        self._changed_hands_at = gripper.header.stamp
        if not gripper.holding or T_world_tcp is None:
            self.held = None
            return
        # A released object may be seen while it falls, as high as if it lay on another one. It is one more object in
        # the container then, not two. Before the first image no slot is known to be free.
        self._free = set(range(len(self._slots))) - self._occupied_slots() if self._occupied else set()
        x, y, z = (float(v) for v in T_world_tcp[:3, 3])
        self._tracks.move_to(gripper.header.stamp * 1e-9)
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
        self.held = m.AttachedObject(link=self.tcp_link, object=thing)
        if track is None and (other := self._handed_over(T_world_tcp)) is not None:
            self._know(other)

    def _know(self, other: m.CollisionObject) -> None:
        """Take over what another arm, which holds the same object, knows of it; the id stays."""
        assert self.held is not None
        known = other.model_copy(update={"id": self.held.object.id})
        self.held, self._undetected_width = self.held.model_copy(update={"object": known}), None

    @property
    def is_undetected(self) -> bool:
        """Whether only the fingers know the held object."""
        return self._undetected_width is not None

    def _handed_over(self, T_world_tcp: Array) -> m.CollisionObject | None:
        """Return what another arm holds between the fingers of this one, in the tool frame."""
        near = [each for each in self.held_by_others if math.dist(
            place_of(each.pose), T_world_tcp[:3, 3]) <= max(each.dimensions)]
        return near[0].model_copy(update={"pose": matrix_to_pose(
            invert(T_world_tcp) @ pose_to_matrix(near[0].pose))}) if near else None

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
        table = [self._object(t.id, "target", t.sighting, _pose(t), t.velocity) for t in self._tracks.confirmed()]
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
        held = [self.held] if self.held is not None else []
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
            if thing.shape != "sphere" and gap > LEVEL and not self._is_on_belt(thing):
                at = m.Vector3(x=thing.pose.position.x, y=thing.pose.position.y, z=self.around.table_height + gap / 2)
                pose = thing.pose.model_copy(update={"position": at})
                columns.append(thing.model_copy(update={
                    "id": f"below_{thing.id}", "role": "fixture", "kind": "", "pose": pose, "mass": 0.0, "color": GREY,
                    "dimensions": [*thing.dimensions[:-1], gap]}))
        return columns

    def _is_on_belt(self, thing: m.CollisionObject) -> bool:
        p, half = thing.pose.position, thing.dimensions[-1] / 2
        return any(belt.carries(p.x, p.y, p.z - half, 0.02) for belt in self.around.conveyors.values())

    def _occupied_slots(self, *, beneath: bool = True) -> set[int]:
        """Return the slots that any current view shows occupied, with or without the ones below that carry them."""
        return {slot for view, one in self._occupied.items() for slot in one.seen | (one.beneath if beneath else set())
                if view in self._occasional_views or (self._stamp - one.stamp) * 1e-9 <= self.p.forget_after}

    def _ball(self, name: str, role: str, pose: m.Pose) -> m.CollisionObject:
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": "sphere", "dimensions": [self.around.ball_radius], "pose": pose,
            "color": color_of(self.around.ball_color),
        })

    def _object(self, name: str, role: str, thing: Sighting, pose: m.Pose,
                velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> m.CollisionObject:
        """Return an object of the planning scene with the detected shape, size and color."""
        x, y, z = velocity
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": thing.shape, "dimensions": thing.dimensions, "pose": pose,
            "color": thing.color, "grip_effort": self.around.grip_efforts.get(thing.kind, 0.0),
            "mass": self.around.masses.get(thing.kind, 0.0), "kind": thing.kind,
            "velocity": m.Vector3(x=x, y=y, z=z),
        })


def _pose(track: Track) -> m.Pose:
    x, y, z = track.position
    return m.Pose(position=m.Vector3(x=x, y=y, z=z), orientation=track.sighting.orientation)
