"""The planning scene as it is believed to be: fixtures, tracked balls, the ball in the hand, balls in the container."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from common import messages as m
from common.applications.pick_place.resting import inside_container
from common.applications.pick_place.tracks import Place, SceneParameters, Tracks
from common.config import GripperConfig, Surroundings
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, matrix_to_pose
from common.scene.fixtures import color_of, fixed_objects
from common.scene.slots import occupied_slots, slot_positions

Array = NDArray[np.float64]


class PerceivedScene:
    """Keeps what was seen and felt, and says it as a planning scene."""

    def __init__(
        self, parameters: SceneParameters, around: Surroundings, gripper: GripperConfig, tcp_link: str
    ) -> None:
        """Start with the fixtures alone.

        Args:
            parameters: of the tracking; they may change meanwhile.
            around: fixtures, container, size and colour of a ball.
            gripper: its links may touch what is held.
            tcp_link: what is held moves with this link.
        """
        self.around, self.gripper, self.tcp_link = around, gripper, tcp_link
        self.p, self._tracks = parameters, Tracks(parameters)
        self._fixed = fixed_objects(around)
        self._slots = slot_positions(around.container, around.ball_radius, around.table_height).reshape(-1, 3)
        self._occupied: dict[int, tuple[int, set[int]]] = {}  # stamp and slots by view
        self._held: m.AttachedObject | None = None
        self._changed_hands_at = 0
        self._stamp = 0

    def see(self, detections: m.MarkerArray, camera: Pinhole, T_world_tcp: Array | None, view: int = 0) -> None:
        """Take in the detections of one frame, of one of several views.

        A frame that was taken before the hand last closed or opened still shows what is in the hand now on the table:
        it is left out. So is anything seen where the hand holds a ball.
        """
        stamp = detections.header.stamp
        if stamp <= self._changed_hands_at:
            return
        self._stamp = max(self._stamp, stamp)
        hand = None
        if self._held is not None and T_world_tcp is not None:
            hand = tuple(T_world_tcp[:3, 3])
        on_table: list[Place] = []
        in_container: list[tuple[float, float]] = []
        for marker in detections.markers:
            p = marker.pose.position
            pixel = marker.pixel or tuple(camera.project([p.x, p.y, p.z]))
            if inside_container(camera, pixel, self.around):
                in_container.append((pixel[0], pixel[1]))
            elif hand is None or math.dist(hand, (p.x, p.y, p.z)) > self.around.ball_radius:
                on_table.append((p.x, p.y, p.z))
        self._tracks.update(on_table, stamp * 1e-9)
        seen = occupied_slots(in_container, camera, self._slots, self.around.ball_radius)
        self._occupied[view] = stamp, seen

    def feel(self, gripper: m.GripperState, T_world_tcp: Array | None) -> None:
        """Take in whether the hand holds something: the nearest ball moves into it with its id, or leaves it."""
        if gripper.holding == (self._held is not None) or (gripper.holding and T_world_tcp is None):
            return
        self._changed_hands_at = gripper.header.stamp
        if not gripper.holding or T_world_tcp is None:
            self._held = None
            return
        x, y, z = (float(v) for v in T_world_tcp[:3, 3])
        track = self._tracks.take((x, y, z), self.p.match_radius)
        # The fingers have centred it between them; along them and along the tool it lies where it was seen.
        offset = np.zeros(3)
        if track is not None:
            offset = (invert(T_world_tcp) @ np.array([*track.position, 1.0]))[:3]
            offset[1] = 0.0
            offset = np.clip(offset, -0.015, 0.015)
        T_tcp_ball = np.eye(4)
        T_tcp_ball[:3, 3] = offset
        ball = self._ball(track.id if track else self._tracks.new_id(), "attached", matrix_to_pose(T_tcp_ball))
        self._held = m.AttachedObject(link=self.tcp_link, object=ball)

    def scene(self) -> m.PlanningScene:
        """What is believed now; its stamp is that of the newest frame in it."""
        table = [
            self._ball(t.id, "target", m.Pose(position=m.Vector3(x=t.position[0], y=t.position[1], z=t.position[2])))
            for t in self._tracks.confirmed()
        ]
        contained = [
            self._ball(f"slot_{k + 1}", "contained", m.Pose(position=m.Vector3(
                x=float(self._slots[k, 0]), y=float(self._slots[k, 1]), z=float(self._slots[k, 2]))))
            for k in sorted(self._occupied_slots())
        ]
        held = [self._held] if self._held is not None else []
        return m.PlanningScene(
            header=m.Header(stamp=self._stamp, frame_id="world"),
            objects=[*self._fixed, *table, *contained],
            attached=held,
            allowed_collisions=[(link, h.object.id) for h in held for link in self.gripper.links],
        )

    def _occupied_slots(self) -> set[int]:
        """Slots in which any view shows something now."""
        return {slot for stamp, slots in self._occupied.values() for slot in slots
                if (self._stamp - stamp) * 1e-9 <= self.p.forget_after}

    def _ball(self, name: str, role: str, pose: m.Pose) -> m.CollisionObject:
        return m.CollisionObject.model_validate({
            "id": name, "role": role, "shape": "sphere", "dimensions": [self.around.ball_radius], "pose": pose,
            "color": color_of(self.around.ball_color),
        })
