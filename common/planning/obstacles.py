"""Robot and obstacles as one pinocchio geometry model, checked with several safety margins.

Building it takes about a millisecond; moving obstacles, allowing pairs and setting margins takes microseconds. So one
bank serves all scenes whose solids have the same shapes. Every margin level has its own pinocchio data and broadphase:
changing the margin of all pairs for each check would cost more than the check.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.errors import ZencellError
from common.messages import CollisionObject
from common.planning.kernel.library import library
from common.planning.kernel.world import CONTACT_ALLOWED, KernelUnavailable, KernelWorld
from common.planning.prism import is_line, prism
from common.planning.robot_geometry import RobotGeometry, largest

Array = NDArray[np.float64]

MARGINS = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # [m]


class InvalidShape(ZencellError):
    """A solid of the scene without volume, or out of range."""


@dataclass(frozen=True)
class Solid:
    """A shape of the scene; `joint` of the robot model carries it, 0 for the environment."""

    shape: str
    dimensions: tuple[float, ...]
    joint: int = 0
    frame: int = 0
    outline: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, item: CollisionObject, joint: int = 0, frame: int = 0) -> Solid:
        """Return the shape of an object of the scene, without its pose.

        Raises:
            InvalidShape: the outline of a prism is a line.
        """
        if item.shape == "prism" and is_line(item.outline):
            raise InvalidShape(f"{item.id}: the {len(item.outline)} points of its outline lie on one line")
        return cls(item.shape, tuple(item.dimensions), joint, frame, tuple(item.outline))

    def geometry(self) -> coal.CollisionGeometry:
        """Return the shape for coal."""
        if self.shape == "box":
            return coal.Box(*self.dimensions)
        if self.shape == "sphere":
            return coal.Sphere(*self.dimensions)
        if self.shape == "prism":
            return prism(self.outline, self.dimensions[0])
        return coal.Cylinder(*self.dimensions)


def cube_mesh(spheres: Array) -> coal.BVHModelOBBRSS:
    """Return a mesh of the cubes about spheres (N, 4), centre and radius [m]."""
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    sides = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
    sides = np.concatenate([sides, [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]])
    vertices = (spheres[:, None, :3] + spheres[:, None, 3:] * signs).reshape(-1, 3)
    triangles = (sides + 8 * np.arange(len(spheres))[:, None, None]).reshape(-1, 3)
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(triangles), len(vertices))
    mesh.addVertices(vertices)
    mesh.addTriangles(triangles.astype(np.int32))
    mesh.endModel()
    return mesh


class _Level:
    """Pinocchio's working data for one margin, and the rules last applied to them."""

    def __init__(self, robot: pin.Model, geometry: pin.GeometryModel) -> None:
        self.data = pin.GeometryData(geometry)
        self.broadphase = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(robot, geometry, self.data)
        self.disabled: frozenset[int] = frozenset()
        self.margins = np.zeros(len(geometry.collisionPairs))

    def apply(self, disabled: frozenset[int], margins: Array) -> None:
        for pair in self.disabled - disabled:
            self.data.activateCollisionPair(pair)
        for pair in disabled - self.disabled:
            self.data.deactivateCollisionPair(pair)
        for pair in np.flatnonzero(self.margins != margins).tolist():
            self.data.collisionRequests[pair].security_margin = float(margins[pair])
        self.disabled = disabled
        self.margins = margins


class Rules:
    """Active pairs and their required distances, checked with any of the margins added."""

    def __init__(self, bank: ObstacleBank) -> None:
        self._bank = bank
        self._levels: list[_Level | None] = [None] * len(MARGINS)
        self._current = [False] * len(MARGINS)
        self.disabled: frozenset[int] = frozenset()
        self.margins = np.zeros(bank.pair_count)

    def set(self, disabled: frozenset[int], margins: Array) -> None:
        """Disable pairs and set the required distance (pairs,) [m] of the others."""
        if disabled != self.disabled or not np.array_equal(margins, self.margins):
            self.margins_changed()
            self.disabled, self.margins = disabled, margins

    def margins_changed(self) -> None:
        """Apply margins again to each level before its next use."""
        self._current = [False] * len(MARGINS)

    def shapes_changed(self) -> None:
        """Build each level again before its next use."""
        self._levels = [None] * len(MARGINS)
        self.margins_changed()

    def _level(self, index: int) -> _Level:
        level = self._levels[index]
        if level is None:
            if self is not self._bank.penetrating:  # it has no pairs with points
                self._bank.mesh_points()
            level = self._levels[index] = _Level(self._bank.model, self._bank.geometry)
        if not self._current[index]:
            level.apply(self.disabled, self.margins + MARGINS[index] * self._bank.shares)
            self._current[index] = True
        return level

    def hit(self, q: Array, level: int = 0) -> bool:
        """Return whether any pair is closer at q than its required distance plus its share of the level's margin."""
        broadphase = self._level(level).broadphase
        return bool(pin.computeCollisions(self._bank.model, self._bank.data, broadphase, q, True))

    def pairs(self, q: Array, level: int = 0) -> list[int]:
        """Return the indices of all pairs that are too close at q. Ten times slower than `hit`."""
        data = self._level(level).data
        pin.computeCollisions(self._bank.model, self._bank.data, self._bank.geometry, data, q, False)
        active = data.activeCollisionPairs
        return [i for i, found in enumerate(data.collisionResults) if active[i] and found.isCollision()]


class ObstacleBank:
    """The robot among solids of given shapes, and sets of points.

    Attributes:
        first, second: geometry indices of each pair; robot geometries come first, then the solids in their order, then
            the sets of points.
        near, far, penetrating: sets of rules over the same geometry.
        lever: (dof,) [m] the farthest that a radian of each joint moves any point of robot or attached objects.
        shares: (pairs,) how much closer a pair can come, as a share of the path of the point that moves most.
    """

    def __init__(self, robot: RobotGeometry, solids: tuple[Solid, ...], point_sets: int = 0) -> None:
        self.model = robot.robot.model
        self.data = self.model.createData()
        self.geometry = robot.geometry.copy()
        self.robot_count = robot.geometry.ngeoms
        gripper = robot.robot.config.gripper
        may_touch_held = set(gripper.links) if gripper else set()
        indices = []
        for number, solid in enumerate(solids):
            item = pin.GeometryObject(
                f"solid_{number}", solid.joint, solid.frame, pin.SE3.Identity(), solid.geometry()
            )
            indices.append(self.geometry.addGeometryObject(item))
        self._points_from = self.robot_count + len(solids)
        for number in range(point_sets):  # the kernel gets the points; coal gets them in `mesh_points`
            placeholder = coal.Sphere(1e-6)
            item = pin.GeometryObject(f"points_{number}", 0, 0, pin.SE3(np.eye(3), np.array([0, 0, -1e3])), placeholder)
            self.geometry.addGeometryObject(item)
        self._spheres: list[Array] = [np.zeros((0, 4))] * point_sets
        self._meshed = self._points_placed = True
        environment = [i for i, solid in zip(indices, solids, strict=True) if solid.joint == 0]
        environment += range(self._points_from, self._points_from + point_sets)
        held = [(i, solid.joint) for i, solid in zip(indices, solids, strict=True) if solid.joint != 0]
        for link in range(self.robot_count):
            if robot.joints[link] != 0:  # the base cannot move: an object next to it is no collision
                self._add_pairs(link, environment)
            for index, joint in held:
                if robot.joints[link] != joint and robot.links[link] not in may_touch_held:
                    self._add_pairs(link, [index])
        for index, _ in held:
            self._add_pairs(index, environment)
        pairs = self.geometry.collisionPairs
        self.pair_count = len(pairs)
        self.first = np.array([pair.first for pair in pairs], dtype=int)
        self.second = np.array([pair.second for pair in pairs], dtype=int)
        self._robot = robot
        self._solids = solids
        self._kernel: KernelWorld | None = None
        self._kernel_tried = self._kernel_placed = False
        self._width: float | None = None
        self._fingers_placed = True  # in the kernel, which copies them when it is created
        self._levers = list(robot.levers)
        self.near = Rules(self)
        self.far = Rules(self)
        self.penetrating = Rules(self)
        self.lever = np.zeros(self.model.nq)
        self.shares = np.zeros(self.pair_count)
        self._measure()

    def _add_pairs(self, one: int, others: list[int]) -> None:
        for other in others:
            self.geometry.addCollisionPair(pin.CollisionPair(one, other))

    def place(self, poses: list[Array]) -> None:
        """Set each solid's (4, 4) pose in the frame of its joint (the world for the environment)."""
        items: Any = self.geometry.geometryObjects
        moved = False
        for number, (solid, pose) in enumerate(zip(self._solids, poses, strict=True)):
            item = items[self.robot_count + number]
            placement = pin.SE3(pose)
            moved = moved or (solid.joint != 0 and not item.placement.isApprox(placement, 1e-9))
            item.placement = placement
        self._kernel_placed = False
        if moved:
            self._measure()

    def open_fingers(self, width: float | None) -> None:
        """Set the gripper's links to a width [m]; None: as in the robot file."""
        if width == self._width:
            return
        self._width, items = width, self.geometry.geometryObjects
        for index, placement, lever in self._robot.opening(width):
            items[index].placement, self._levers[index] = placement, lever
        self._fingers_placed = self._kernel_placed = False
        self._measure()

    def set_points(self, sets: Sequence[Array]) -> None:
        """Set the spheres (N, 4), centre and radius [m], world, of each set of points, without a copy."""
        if len(sets) != len(self._spheres):
            raise ValueError(f"got {len(sets)} sets of points, need {len(self._spheres)}")
        if all(new is old for new, old in zip(sets, self._spheres, strict=True)):
            return
        self._spheres = list(sets)
        self._meshed = self._points_placed = self._kernel_placed = False
        for rules in (self.near, self.far):
            rules.shapes_changed()

    def mesh_points(self) -> None:
        """Give coal each sphere as the cube about it. That takes 30 us each, so only if coal is used."""
        if self._meshed:
            return
        self._meshed = True
        items = self.geometry.geometryObjects
        for number, spheres in enumerate(self._spheres):
            items[self._points_from + number].geometry = cube_mesh(spheres) if len(spheres) else coal.Sphere(1e-6)
            at = (0, 0, 0) if len(spheres) else (0, 0, -1e3)
            items[self._points_from + number].placement = pin.SE3(np.eye(3), np.array(at, dtype=float))

    def near_shapes(self, q: Array, margins: Array, points: Array) -> NDArray[np.bool_]:
        """Return (N,) which of points (N, 3), world, are within a margin [m] of robot or solids at q.

        Args:
            margins: (robot and solids,) [m] of each.
        """
        kernel = self.kernel()
        if kernel is not None:
            own = np.full(len(self.geometry.geometryObjects), CONTACT_ALLOWED)
            own[: len(margins)] = margins
            return kernel.near(q, own, points)
        data = pin.GeometryData(self.geometry)
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, data, q)
        found = np.zeros(len(points), dtype=bool)
        dot, identity = coal.Sphere(1e-9), np.eye(3)
        for i, margin in enumerate(margins.tolist()):
            shape = self.geometry.geometryObjects[i].geometry
            shape.computeLocalAABB()
            placement = data.oMg[i]
            away = np.linalg.norm(points - placement.act(np.array(shape.aabb_center)), axis=1)
            at = coal.Transform3s(placement.rotation, placement.translation)
            for k in np.flatnonzero(~found & (away <= shape.aabb_radius + margin)).tolist():
                where = coal.Transform3s(identity, points[k])
                request, result = coal.DistanceRequest(), coal.DistanceResult()
                found[k] = coal.distance(shape, at, dot, where, request, result) <= margin
        return found

    def kernel(self) -> KernelWorld | None:
        """Return the same geometry in the compiled kernel, with current poses; None if the kernel is unavailable."""
        if library() is None:
            return None
        if not self._kernel_tried:
            self._kernel_tried = True
            try:
                points = range(self._points_from, self._points_from + len(self._spheres))
                self._kernel = KernelWorld(self.model, self.geometry, self._robot.kernel_shapes, points)
            except KernelUnavailable:
                return None
        if self._kernel is not None and not self._kernel_placed:
            items = self.geometry.geometryObjects
            if not self._fingers_placed:
                for index, placement, _ in self._robot.opening(self._width):
                    self._kernel.set_pose(index, placement.homogeneous)
            self._fingers_placed = True
            for index in range(self.robot_count, self._points_from):
                self._kernel.set_pose(index, items[index].placement.homogeneous)
            if not self._points_placed:
                for number, spheres in enumerate(self._spheres):
                    self._kernel.set_points(self._points_from + number, spheres)
                self._points_placed = True
            self._kernel.refresh()
        self._kernel_placed = True
        return self._kernel

    def distances(self, q: Array, pairs: Sequence[int]) -> Array:
        """Return (len(pairs),) distances [m] at q (dof,), negative by the penetration depth."""
        data = pin.GeometryData(self.geometry)
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, data, q)
        return np.array([pin.computeDistance(self.geometry, data, i).min_distance for i in pairs], dtype=float)

    def _measure(self) -> None:
        """Update levers and each pair's share: only joints between two links move them towards each other."""
        items = self.geometry.geometryObjects
        held = [self._robot.lever(items[i]) for i in range(self.robot_count, len(items))]
        levers = np.array([*self._levers, *held])
        self.lever = largest(list(levers))
        between = np.where((levers[self.first] > 0) & (levers[self.second] > 0), 0.0, 1.0)
        way = np.maximum(levers[self.first], levers[self.second]) * between
        shares = np.max(way / np.maximum(self.lever, 1e-9), axis=1, initial=0.0)
        if not np.array_equal(shares, self.shares):
            self.shares = shares
            for rules in (self.near, self.far, self.penetrating):
                rules.margins_changed()


class ObstacleCache:
    """The banks used last, by their shapes. A bank belongs to the newest world created with it."""

    def __init__(self, robot: RobotGeometry, size: int = 8) -> None:
        self.robot = robot
        self._size = size
        self._banks: OrderedDict[tuple[tuple[Solid, ...], int], ObstacleBank] = OrderedDict()

    def bank(self, solids: tuple[Solid, ...], point_sets: int = 0) -> ObstacleBank:
        """Return the bank for these shapes and this number of point sets; build it if missing."""
        key = (solids, point_sets)
        found = self._banks.get(key)
        if found is None:
            found = self._banks[key] = ObstacleBank(self.robot, solids, point_sets)
            if len(self._banks) > self._size:
                self._banks.popitem(last=False)
        self._banks.move_to_end(key)
        return found
