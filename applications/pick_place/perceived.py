"""The planning scene as it is believed to be: fixtures, tracked objects, and those in the hand and the container."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from applications.pick_place.resting import Resting
from applications.pick_place.tracks import SceneParameters, Sighting, Track, Tracks
from common import messages as m
from common.config import GripperConfig, Surroundings
from common.perception.occlusion import Occlusion
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix
from common.scene.fixtures import color_of, fixed_objects
from common.scene.slots import occupied_slots, slot_positions

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
            lambda place: bool(hidden.occludes([place], radius)[0])))
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
        behind = hidden.occludes(self._slots[slots], self.around.ball_radius)
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
