"""Rules of contact for one request: pairs of links and objects, and the distance that each pair requires."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.errors import UnknownName
from common.messages import CollisionObject, PlanningScene, Pose
from common.planning.constraints import ToolConstraints
from common.planning.kernel.world import CONTACT_ALLOWED, KernelWorld
from common.planning.obstacles import MARGINS, InvalidShape, ObstacleBank, ObstacleCache, Rules, Solid
from common.planning.point_obstacles import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.robot.transforms import invert, pose_to_matrix

Array = NDArray[np.float64]
Pair = tuple[str, str]

PERCEIVED = ("target", "contained", "attached")  # roles of objects with padding
_CONTACT_SLACK = 1  # margin level [1 mm] within which an attached object counts as touching at the start
_FARTHEST_HELD = 100.0  # [m] from a joint that an attached object may reach
_DEEPER = 2e-4  # [m] more penetration than at the start: rounding, and how far a followed line may be off


class ContactRules:
    """The robot among the solids of a scene, with the changes that a request asks for.

    Perceived objects get `padding` more distance [m]. Three kinds of contact are allowed:
    - pairs in the scene's and the request's allowed collisions, always;
    - an attached object with the gripper's links, always;
    - what an attached object touches at the start, and perceived objects into whose padding (not into themselves) a
      link reaches at the start: until the TCP is `contact_distance` away from where it was at the start. For points,
      only their padding is ignored, for attached objects, too.
    """

    def __init__(
        self,
        robot: RobotModel,
        scene: PlanningScene,
        *,
        start: ArrayLike,
        padding: float = 0.0,
        clearance: float = 0.0,
        allowed: Iterable[Pair] = (),
        attach: str = "",
        attach_pose: Pose | None = None,
        release: bool = False,
        contact_distance: float = 0.02,
        cache: ObstacleCache | None = None,
        constraints: ToolConstraints | None = None,
        points: Sequence[PointObstacle] = (),
        width: float | None = None,
    ) -> None:
        """Set up the scene for a motion that starts at `start` (dof,) [rad].

        Args:
            robot: the model.
            scene: obstacles and attached objects; its poses are in the base frame.
            start: joint positions at which contact and the pose of the attached object are taken.
            padding: additional distance from perceived objects [m]; clearance: from everything around the robot [m].
            allowed: pairs of link or object names that may touch, besides the scene's.
            attach: the only object that moves with the TCP: an attached one, or one of the scene from its present pose.
            attach_pose: of that object in the TCP frame, if not attached yet; default: its pose relative to the start.
            release: nothing is attached.
            contact_distance: travel of the TCP [m] until which contact at the start is allowed: for attached objects to
                the depth that they have there, for the robot within padding only.
            cache: built geometry to use again; a world created with it earlier must not be used any more.
            constraints: of the tool.
            points: what cameras saw and the scene does not have; padded as perceived objects are.
            width: of the gripper [m], the widest if it moves on the way; None: as in the robot file.

        Raises:
            UnknownName: `attach` is not in the scene.
            InvalidShape: an attached object reaches too far.
        """
        self.robot = robot
        self.constraints = constraints
        self.start: Array = np.array(start, dtype=float)
        self.cache = cache or ObstacleCache(RobotGeometry(robot))
        T_world_tcp_start = robot.fk(self.start)
        self._origin = T_world_tcp_start[:3, 3].copy()
        self.contact_distance = contact_distance
        environment, held = _split_scene(robot, scene, T_world_tcp_start, attach, attach_pose, release)
        margins = self._load(environment, held, points, width, padding, clearance)
        self._set_rules(margins, _pairs_named(self._bank, self._names, (*scene.allowed_collisions, *allowed)))
        self._lever = self._bank.lever
        if held and not self._lever.max() <= _FARTHEST_HELD:  # pieces of 1 mm of its path would be too many
            raise InvalidShape(f"{held[0][0].id}: the attached object reaches {self._lever.max():.3g} m from a joint; "
                               f"the limit is {_FARTHEST_HELD:g} m")
        self._tcp_lever = _tcp_lever(self.cache.robot)

    def _set_rules(self, margins: Array, disabled: frozenset[int]) -> None:
        """Set the rules away from the start and near it, with (pairs,) the required distances [m]."""
        self._far = self._bank.far
        self._far.set(disabled, margins)
        self._kernel = self._bank.kernel()
        if self._kernel is not None:
            self._kernel.set_rules(required_distances(self._far))
            (self.constraints or ToolConstraints.none(self.robot)).attach_to_kernel(self._kernel)
        self._penetrating: Rules | None = None  # pairs whose depth at the start coal measures; the kernel cannot
        self._near = self._rules_at_start(disabled, margins)
        self._send_rules_to_kernel()

    def _load(
        self, environment: list[CollisionObject], held: list[tuple[CollisionObject, int, Array]],
        points: Sequence[PointObstacle], width: float | None, padding: float, clearance: float,
    ) -> Array:
        """Place all geometry; return (pairs,) the required distances [m]."""
        objects = [*environment, *(item for item, _, _ in held)]
        solids = [Solid.of(o) for o in environment]
        solids += [Solid.of(o, self.robot.model.frames[frame].parentJoint, frame) for o, frame, _ in held]
        self._bank = self.cache.bank(tuple(solids), len(points))
        self._bank.open_fingers(width)
        self._bank.set_points([seen.spheres for seen in points])
        self._bank.place([pose_to_matrix(o.pose) for o in environment] + [pose for _, _, pose in held])
        self._names = [*self.cache.robot.links, *(o.id for o in objects), *(seen.name for seen in points)]
        self._held_from = self._bank.robot_count + len(environment)
        self._points_from = self._held_from + len(held)
        self.attached: list[str] = [o.id for o, _, _ in held]
        padded = np.array(
            [0.0] * self._bank.robot_count
            + [clearance + (padding if o.role in PERCEIVED else 0.0) for o in environment]
            + [padding if o.role in PERCEIVED else 0.0 for o, _, _ in held]
            + [clearance + padding] * len(points)
        )
        return np.asarray(padded[self._bank.first] + padded[self._bank.second])

    def _send_rules_to_kernel(self) -> None:
        if self._kernel is None or self._near is self._far:
            return
        tool = self.robot.model.frames[self.robot.tcp_frame]
        self._kernel.set_rules(
            required_distances(self._far), required_distances(self._near), tool.parentJoint,
            np.array(tool.placement.translation), self._origin,
            self.contact_distance,
        )

    def _close_at_start(self, level: int) -> list[int]:
        """Return pairs that are too close at the start, with the level's margin added."""
        if self._kernel is None:
            return self._far.pairs(self.start, level) if self._far.hit(self.start, level) else []
        least = required_distances(self._far)
        more = np.where(least > CONTACT_ALLOWED, MARGINS[level] * self._bank.shares, 0.0)
        return np.flatnonzero(self._kernel.distances(self.start)[0] <= least + more).tolist()

    def _rules_at_start(self, disabled: frozenset[int], margins: Array) -> Rules:
        """Return rules while the TCP is near its start: the far ones, less the contact that is allowed there."""
        close = self._close_at_start(_CONTACT_SLACK)
        if not close:
            return self._far
        first, second = self._bank.first, self._bank.second
        last = np.maximum(first, second)
        touching = [i for i in close if self._held_from <= last[i] < self._points_from]
        near_margins = margins.copy()
        near_margins[self._close_at_start(0)] = 0.0
        near_margins[touching] = np.minimum(0.0, self._bank.distances(self.start, touching)) - _DEEPER
        if np.array_equal(near_margins, margins):
            return self._far
        self._bank.near.set(disabled, near_margins)
        if touching and self._kernel is not None:
            self._penetrating = self._bank.penetrating
            self._penetrating.set(frozenset(range(self._bank.pair_count)).difference(touching), near_margins)
        return self._bank.near

    @property
    def kernel(self) -> KernelWorld | None:
        """The compiled kernel with this world's rules; None if the kernel is unavailable."""
        return self._kernel

    @property
    def bank(self) -> ObstacleBank:
        """The geometry: the robot among the solids of the scene."""
        return self._bank

    def rules_at(self, q: Array) -> Rules:
        """Return the active pairs and required distances with the robot at q (dof,) [rad]."""
        return self._near if self._near is not self._far and self._travel(q) < self.contact_distance else self._far

    def pair(self, index: int) -> Pair:
        """Return the names of a pair: a link or attached object, and the other."""
        return self._names[self._bank.first[index]], self._names[self._bank.second[index]]

    def _travel(self, q: Array) -> float:
        """Return the distance [m] of the TCP at q from where it was at the start."""
        frame = self.robot.model.frames[self.robot.tcp_frame]
        data = self._bank.data
        pin.forwardKinematics(self.robot.model, data, q)
        return math.dist(data.oMi[frame.parentJoint].act(frame.placement.translation), self._origin)

    def _coal_rules_at(self, q: Array) -> Rules | None:
        """Return the rules that coal checks at q: all without the kernel, else those that the kernel cannot check."""
        if self._kernel is None:
            return self.rules_at(q)
        return self._penetrating if self._penetrating is not None and self._travel(q) < self.contact_distance else None


def _tcp_lever(geometry: RobotGeometry) -> Array:
    """Return (dof,) [m] how far the TCP moves per radian: it may lie outside the hulls, which have levers too."""
    frame = geometry.robot.tcp_frame
    tcp = geometry.robot.model.frames[frame]
    return geometry.lever(pin.GeometryObject("tcp", tcp.parentJoint, frame, tcp.placement, coal.Sphere(1e-6)))


def _split_scene(
    robot: RobotModel, scene: PlanningScene, T_world_tcp: Array, attach: str, attach_pose: Pose | None, release: bool
) -> tuple[list[CollisionObject], list[tuple[CollisionObject, int, Array]]]:
    """Return the environment, and attached objects: object, frame, (4, 4) pose in the frame of the carrying joint."""
    environment = list(scene.objects)
    if release:
        return environment, []
    model = robot.model
    held = []
    for item in scene.attached:
        if attach and item.object.id != attach:
            continue  # released before the motion takes the other object
        frame = robot.frame(item.link)
        T_joint_link = model.frames[frame].placement.homogeneous
        held.append((item.object, frame, T_joint_link @ pose_to_matrix(item.object.pose)))
    if attach and attach not in {item.id for item, _, _ in held}:
        found = next((o for o in environment if o.id == attach), None)
        if found is None:
            raise UnknownName("object", attach, [o.id for o in environment] + [item.id for item, _, _ in held])
        frame = robot.tcp_frame
        T_joint_tcp = model.frames[frame].placement.homogeneous
        T_tcp_object = invert(T_world_tcp) @ pose_to_matrix(found.pose)
        if attach_pose is not None:
            T_tcp_object = pose_to_matrix(attach_pose)
        held.append((found, frame, T_joint_tcp @ T_tcp_object))
    names = {item.id for item, _, _ in held}
    return [o for o in environment if o.id not in names], held


def _pairs_named(bank: ObstacleBank, names: Sequence[str], allowed: Iterable[Pair]) -> frozenset[int]:
    """Return indices of the pairs with these names, in either order; unknown names are ignored."""
    indices: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        indices.setdefault(name, []).append(i)
    first, second = bank.first, bank.second
    found: set[int] = set()
    for a, b in allowed:
        one, other = indices.get(a, []), indices.get(b, [])
        either = (np.isin(first, one) & np.isin(second, other)) | (np.isin(first, other) & np.isin(second, one))
        found.update(np.flatnonzero(either).tolist())
    return frozenset(found)


def required_distances(rules: Rules) -> Array:
    """Return the required distance of each pair (pairs,) [m], CONTACT_ALLOWED for pairs that may touch."""
    least = np.where(rules.margins < 0, CONTACT_ALLOWED, rules.margins)
    least[list(rules.disabled)] = CONTACT_ALLOWED
    return least
