"""The planning scene of the sorting cell: fixtures, containers, seen objects, foreign bodies and the held object."""

from __future__ import annotations

import math
from itertools import count

import numpy as np
import numpy.typing as npt

from applications.sorting.places import require_tray
from applications.sorting.topics import Foreign, Heap, SeenObject
from common import messages as m
from common.config import Surroundings
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix
from common.scene.fixtures import fixed_objects

Array = npt.NDArray[np.float64]

FOREIGN = "foreign"  # kind and prefix of the id of a foreign body
LEAST_HEIGHT = 0.004  # [m] of a solid
LEAST_SIDE = 0.004  # [m]
GROWN = 0.004  # [m] by which a held object is larger than it was seen: its hidden sides, and its motion in the grasp
REACH = 0.06  # [m] from the tool to the outline of an object that is held
UNKNOWN = 0.08  # [m] height of a held object that was not seen before
IN_TRAY = 0.25  # [m] height of a tool above the table from which on it is not in the tray
MOST_SEEN = 300  # objects of a planning scene


def prism(thing: SeenObject, grown: float = 0.0) -> m.CollisionObject:
    """Return an object as an upright prism from its support to its top, `grown` [m] larger on each side."""
    corners = np.array(thing.outline, float).reshape(-1, 2)
    if len(corners) < 3:
        corners = _rectangle(thing)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    corners = corners - middle
    if grown:
        away = np.linalg.norm(corners, axis=1, keepdims=True)
        corners = corners * (1 + grown / np.maximum(away, LEAST_SIDE))
    height = max(thing.top - thing.bottom, LEAST_HEIGHT) + 2 * grown
    return m.CollisionObject(
        id=thing.id, role="target", shape="prism", dimensions=[height], color=thing.color,
        outline=[(float(x), float(y)) for x, y in corners],
        pose=m.Pose(position=m.Vector3(x=float(middle[0]), y=float(middle[1]), z=(thing.top + thing.bottom) / 2)),
    )


def _rectangle(thing: SeenObject) -> Array:
    x, y = max(thing.size.x, LEAST_SIDE) / 2, max(thing.size.y, LEAST_SIDE) / 2
    c, s = math.cos(thing.yaw), math.sin(thing.yaw)
    corners = np.array([(x, y), (-x, y), (-x, -y), (x, -y)]) @ np.array([(c, s), (-s, c)])
    return np.asarray(corners + np.array([thing.center.x, thing.center.y]))


def foreign_box(index: int, body: Foreign) -> m.CollisionObject:
    """Return a foreign body as a box."""
    sides = [max(side, LEAST_SIDE) for side in (body.size.x, body.size.y, body.size.z)]
    return m.CollisionObject(
        id=f"{FOREIGN}_{index}", role="target", shape="box", dimensions=sides, kind=FOREIGN,
        pose=m.Pose(position=body.center), color=m.Color(r=1.0, g=0.2, b=0.8, a=0.7))


def distance_to(thing: SeenObject, place: tuple[float, float]) -> float:
    """Return the distance [m] of a position (x, y) from the outline of an object; negative inside."""
    corners = np.array(thing.outline, float).reshape(-1, 2)
    if len(corners) < 3:
        corners = _rectangle(thing)
    ends = np.roll(corners, -1, axis=0)
    along, to = ends - corners, np.array(place) - corners
    share = np.clip((to * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    nearest = float(np.linalg.norm(to - share[:, None] * along, axis=1).min())
    sides = along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]
    return -nearest if (sides >= 0).all() or (sides <= 0).all() else nearest


def unseen_object(width: float) -> m.CollisionObject:
    """Return what is held if it was never seen: a box around the tool, as wide as the fingers are apart [m]."""
    return m.CollisionObject(
        id="held", role="attached", shape="box", dimensions=[0.06, max(width, LEAST_SIDE), UNKNOWN],
        pose=m.Pose(), color=m.Color(r=0.6, g=0.6, b=0.6))


class SortingScene:
    """Solids of the cell. Objects are those of the newest image that the arm did not hide; foreign ones are always new.

    Attributes:
        held: the attached object, its pose in the frame of the tool; None without one.
    """

    def __init__(self, around: Surroundings, tcp_link: str, tray: str = "tray") -> None:
        """Start with fixtures and containers only.

        Raises:
            ConfigError: the world has no such tray.
        """
        require_tray(around, tray, "services.sorting_scene.tray")
        self._fixed, self._tcp_link = fixed_objects(around), tcp_link
        self._containers = set(around.containers) - {tray}
        box = around.containers[tray]
        self._above_tray, self._half = np.array([box.x, box.y, around.table_height]), box.half_side
        self._objects: list[SeenObject] = []
        self._foreign: list[Foreign] = []
        self._stamp = self._settled = 0
        self._holding = False
        self.held: m.CollisionObject | None = None

    def update_heap(self, heap: Heap, T_world_tcp: Array | None = None) -> None:
        """Take what an image shows; while the tool is in the tray only its foreign bodies: the image is older.

        Motions into the tray are planned by the objects that it showed before.
        """
        self._stamp, self._foreign = heap.header.stamp, heap.foreign
        if heap.at_home and not (T_world_tcp is not None and self._is_in_tray(T_world_tcp)):
            self._objects, self._settled = self._distinct(heap.objects[:MOST_SEEN]), heap.header.stamp

    def _distinct(self, things: list[SeenObject]) -> list[SeenObject]:
        """Rename objects whose ids are those of others or of fixed solids: pairs that may touch are named by ids."""
        used = {solid.id for solid in self._fixed}
        result = []
        numbers = count(1)
        for thing in things:
            name = thing.id
            while name in used or name.startswith(f"{FOREIGN}_"):
                name = f"object_{next(numbers)}"
            used.add(name)
            result.append(thing if name == thing.id else thing.model_copy(update={"id": name}))
        return result

    def _is_in_tray(self, T_world_tcp: Array) -> bool:
        x, y, z = T_world_tcp[:3, 3] - self._above_tray
        return bool(max(abs(x), abs(y)) < self._half and z < IN_TRAY)

    def update_gripper(self, state: m.GripperState, T_world_tcp: Array | None) -> bool:
        """Attach the object under the tool once the gripper holds something; return whether that changed.

        Args:
            state: of the gripper.
            T_world_tcp: (4, 4) pose of the tool; None while unknown.
        """
        if state.holding == self._holding or (state.holding and T_world_tcp is None):
            return False
        self._holding = state.holding
        if not state.holding or T_world_tcp is None:
            self.held = None
            return True
        x, y, z = (float(value) for value in T_world_tcp[:3, 3])
        near = [(distance_to(thing, (x, y)), thing) for thing in self._objects
                if thing.bottom - REACH < z < thing.top + REACH]
        off, thing = min(near, key=lambda one: one[0], default=(math.inf, None))
        if thing is None or off > REACH:
            self.held = unseen_object(state.width)
            return True
        solid = prism(thing, GROWN)
        pose = matrix_to_pose(invert(T_world_tcp) @ pose_to_matrix(solid.pose))
        self.held = solid.model_copy(update={"role": "attached", "pose": pose})
        self._objects = [other for other in self._objects if other is not thing]
        return True

    def scene(self) -> m.PlanningScene:
        """Return the planning scene; an object with the id of the held one is renamed."""
        objects = [prism(thing).model_copy(update={
            "role": "contained" if thing.place in self._containers else "target"}) for thing in self._objects]
        attached = []
        if self.held is not None:
            held = self.held.id
            objects = [each.model_copy(update={"id": f"{held}_"}) if each.id == held else each for each in objects]
            attached = [m.AttachedObject(link=self._tcp_link, object=self.held)]
        foreign = [foreign_box(index, body) for index, body in enumerate(self._foreign, 1)]
        return m.PlanningScene(
            header=m.Header(stamp=self._stamp, frame_id="world"), settled=self._settled,
            objects=[*self._fixed, *objects, *foreign], attached=attached)
