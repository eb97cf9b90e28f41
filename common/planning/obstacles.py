"""Robot and obstacles as one pinocchio geometry model, checked with several safety margins.

Building it takes about a millisecond; moving obstacles, allowing pairs and setting margins takes microseconds, so one
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
from common.planning.kernel.world import KernelWorld, NoKernel
from common.planning.prism import is_line, prism
from common.planning.robot_geometry import RobotGeometry, largest

Array = NDArray[np.float64]

MARGINS = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # [m]


class BadShape(ZencellError):
    """A solid of the scene that has no volume."""


@dataclass(frozen=True)
class Solid:
    """A shape of the scene; `joint` is that of the robot model which carries it, 0 for the environment."""

    shape: str
    dimensions: tuple[float, ...]
    joint: int = 0
    frame: int = 0
    outline: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, thing: CollisionObject, joint: int = 0, frame: int = 0) -> Solid:
        """The shape of an object of the scene, wherever it is.

        Raises:
            BadShape: the outline of a prism is a line.
        """
        if thing.shape == "prism" and is_line(thing.outline):
            raise BadShape(f"{thing.id}: the {len(thing.outline)} points of its outline lie on one line")
        return cls(thing.shape, tuple(thing.dimensions), joint, frame, tuple(thing.outline))

    def geometry(self) -> coal.CollisionGeometry:
        """The shape as coal knows it."""
        if self.shape == "box":
            return coal.Box(*self.dimensions)
        if self.shape == "sphere":
            return coal.Sphere(*self.dimensions)
        if self.shape == "prism":
            return prism(self.outline, self.dimensions[0])
        return coal.Cylinder(*self.dimensions)


class _Level:
    """Pinocchio's working data for one margin, and what was last set in them."""

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
    """Which pairs count and how far apart they must be: checked with any of the margins on top."""

    def __init__(self, bank: ObstacleBank) -> None:
        self._bank = bank
        self._levels: list[_Level | None] = [None] * len(MARGINS)
        self._current = [False] * len(MARGINS)
        self.disabled: frozenset[int] = frozenset()
        self.margins = np.zeros(bank.pair_count)

    def set(self, disabled: frozenset[int], margins: Array) -> None:
        """Disable pairs and set the least distance (pairs,) [m] of the others."""
        if disabled != self.disabled or not np.array_equal(margins, self.margins):
            self.margins_changed()
            self.disabled, self.margins = disabled, margins

    def margins_changed(self) -> None:
        """Have the levels set their margins again before they are used."""
        self._current = [False] * len(MARGINS)

    def _level(self, index: int) -> _Level:
        level = self._levels[index]
        if level is None:
            level = self._levels[index] = _Level(self._bank.model, self._bank.geometry)
        if not self._current[index]:
            level.apply(self.disabled, self.margins + MARGINS[index] * self._bank.shares)
            self._current[index] = True
        return level

    def hit(self, q: Array, level: int = 0) -> bool:
        """Whether any pair is closer at q than its own distance and its share of the level's margin together."""
        broadphase = self._level(level).broadphase
        return bool(pin.computeCollisions(self._bank.model, self._bank.data, broadphase, q, True))

    def pairs(self, q: Array, level: int = 0) -> list[int]:
        """Indices of all pairs that are too close at q. Ten times slower than `hit`."""
        data = self._level(level).data
        pin.computeCollisions(self._bank.model, self._bank.data, self._bank.geometry, data, q, False)
        active = data.activeCollisionPairs
        return [i for i, found in enumerate(data.collisionResults) if active[i] and found.isCollision()]


class ObstacleBank:
    """The robot among solids of given shapes.

    Attributes:
        first, second: geometry indices of each pair; robot geometries come first, then the solids in their order.
        near, far, sunk: sets of rules over the same geometry.
        lever: (dof,) [m] the farthest that a radian of each joint moves any point of the robot or of what is attached.
        shares: (pairs,) how much closer two things can come, as a share of the way of the point that moves most.
    """

    def __init__(self, robot: RobotGeometry, solids: tuple[Solid, ...]) -> None:
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
        environment = [i for i, solid in zip(indices, solids, strict=True) if solid.joint == 0]
        held = [(i, solid.joint) for i, solid in zip(indices, solids, strict=True) if solid.joint != 0]
        for link in range(self.robot_count):
            if robot.joints[link] != 0:  # the base cannot move: what stands beside it is no collision
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
        self.near = Rules(self)
        self.far = Rules(self)
        self.sunk = Rules(self)
        self.lever = np.zeros(self.model.nq)
        self.shares = np.zeros(self.pair_count)
        self._measure()

    def _add_pairs(self, one: int, others: list[int]) -> None:
        for other in others:
            self.geometry.addCollisionPair(pin.CollisionPair(one, other))

    def place(self, poses: list[Array]) -> None:
        """Put each solid at its (4, 4) pose in the frame of its joint (the world for the environment)."""
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

    def kernel(self) -> KernelWorld | None:
        """The same geometry, where solids stand now, in the compiled kernel; None where it cannot be used."""
        if not self._kernel_tried:
            self._kernel_tried = True
            try:
                self._kernel = KernelWorld(self.model, self.geometry, self._robot.kernel_shapes)
            except NoKernel:
                return None
        elif self._kernel is not None and not self._kernel_placed:
            items = self.geometry.geometryObjects
            for index in range(self.robot_count, len(items)):
                self._kernel.place(index, items[index].placement.homogeneous)
            self._kernel.placed()
        self._kernel_placed = True
        return self._kernel

    def distances(self, q: Array, pairs: Sequence[int]) -> Array:
        """(len(pairs),) [m] at q (dof,), negative by how deep two things are in each other."""
        data = pin.GeometryData(self.geometry)
        pin.updateGeometryPlacements(self.model, self.data, self.geometry, data, q)
        return np.array([pin.computeDistance(self.geometry, data, i).min_distance for i in pairs], dtype=float)

    def _measure(self) -> None:
        """Levers, and each pair's share: joints between two links alone move them towards each other."""
        items = self.geometry.geometryObjects
        held = [self._robot.lever(items[i]) for i in range(self.robot_count, len(items))]
        levers = np.array([*self._robot.levers, *held])
        self.lever = largest(list(levers))
        between = np.where((levers[self.first] > 0) & (levers[self.second] > 0), 0.0, 1.0)
        way = np.maximum(levers[self.first], levers[self.second]) * between
        shares = np.max(way / np.maximum(self.lever, 1e-9), axis=1, initial=0.0)
        if not np.array_equal(shares, self.shares):
            self.shares = shares
            for rules in (self.near, self.far, self.sunk):
                rules.margins_changed()


class ObstacleCache:
    """Banks that were used last, by the shapes in them. A bank belongs to the newest world made with it."""

    def __init__(self, robot: RobotGeometry, size: int = 8) -> None:
        self.robot = robot
        self._size = size
        self._banks: OrderedDict[tuple[Solid, ...], ObstacleBank] = OrderedDict()

    def bank(self, solids: tuple[Solid, ...]) -> ObstacleBank:
        """The bank for these shapes, built when there is none."""
        found = self._banks.get(solids)
        if found is None:
            found = self._banks[solids] = ObstacleBank(self.robot, solids)
            if len(self._banks) > self._size:
                self._banks.popitem(last=False)
        self._banks.move_to_end(solids)
        return found
