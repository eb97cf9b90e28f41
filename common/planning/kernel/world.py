"""The robot among obstacles as the kernel knows it, made from pinocchio's models."""

from __future__ import annotations

import threading
from collections.abc import Collection, Sequence
from ctypes import CDLL, byref, c_double, c_int
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.errors import ZencellError
from common.planning.kernel.library import library

Array = NDArray[np.float64]

EXCUSED = -1e9  # [m] the margin of a pair that may touch
_SPHERE, _BOX, _CYLINDER, _CAPSULE, _HULL, _POINTS = range(6)
_LARGEST = 1e7  # [m] beyond which rounding would count
_JOINTS = (
    *(f"JointModel{kind}{axis}" for kind in "RP" for axis in "XYZ"),
    *(f"JointModel{kind}Unaligned" for kind in ("Revolute", "Prismatic")),
)


class NoKernel(ZencellError):
    """The kernel is not built here, or does not know a joint or a shape."""


@dataclass(frozen=True)
class Shape:
    """A shape as the kernel wants it: kind, dimensions (3,), vertices (N, 3) of a hull and a sphere (4,) about them."""

    kind: int
    size: Array
    points: Array
    sphere: Array

    @classmethod
    def of(cls, shape: coal.CollisionGeometry) -> Shape:
        """A shape of coal's.

        Raises:
            NoKernel: it is none that the kernel knows.
        """
        if isinstance(shape, coal.ShapeBase) and shape.getSweptSphereRadius() > 0:
            raise NoKernel(f"the planning kernel takes no {type(shape).__name__} with a swept sphere")
        found = cls._known(shape)
        if not (np.abs(found.size) < _LARGEST).all() or not (np.abs(found.points) < _LARGEST).all():
            raise NoKernel(f"the planning kernel takes no {type(shape).__name__} of more than {_LARGEST:g} m")
        return found

    @classmethod
    def _known(cls, shape: coal.CollisionGeometry) -> Shape:
        none, nothing = np.zeros((0, 3)), np.zeros(4)
        if isinstance(shape, coal.Sphere):
            return cls(_SPHERE, np.array([shape.radius, 0, 0]), none, nothing)
        if isinstance(shape, coal.Box):
            return cls(_BOX, 2 * np.array(shape.halfSide), none, nothing)
        if isinstance(shape, coal.Cylinder | coal.Capsule):
            kind = _CYLINDER if isinstance(shape, coal.Cylinder) else _CAPSULE
            return cls(kind, np.array([shape.radius, 2 * shape.halfLength, 0]), none, nothing)
        if isinstance(shape, coal.Convex):
            points = np.array([shape.point(i) for i in range(shape.num_points)], dtype=float)
            return cls(_HULL, np.zeros(3), points, _sphere(points))
        raise NoKernel(f"the planning kernel takes no {type(shape).__name__}")


class KernelWorld:
    """Answers of the compiled kernel for one robot among obstacles. Of several threads one is answered at a time.

    Pairs are those of the geometry model, in its order.
    """

    def __init__(
        self,
        model: pin.Model,
        geometry: pin.GeometryModel,
        known: Sequence[Shape] = (),
        points: Collection[int] = (),
    ) -> None:
        """Copy joints, shapes, placements and pairs.

        Args:
            model: joints; geometry: shapes and pairs.
            known: the first of the shapes, where they were read before: reading a hull takes a millisecond.
            points: shapes of the environment that stand for sets of points, empty until `set_points`; they are paired
                with what moves alone.

        Raises:
            NoKernel: there is no library, or something in the models is not known to it.
        """
        self._world = self._scratch = None
        self._lock = threading.Lock()  # other threads run while the kernel works
        self.library, self._world = joints_of(model)
        self.dof: int = model.nq
        self.pair_count = len(geometry.collisionPairs)
        self._shape_count = geometry.ngeoms
        for i, item in enumerate(geometry.geometryObjects):
            if i in points:
                shape = Shape(_POINTS, np.zeros(3), np.zeros((0, 3)), np.zeros(4))
            else:
                shape = known[i] if i < len(known) else Shape.of(item.geometry)
            self._add(item, shape)
        self._points = frozenset(points)
        pairs = np.array([(pair.first, pair.second) for pair in geometry.collisionPairs], dtype=np.int32).reshape(-1, 2)
        first, second = pairs[:, 0].copy(), pairs[:, 1].copy()
        if not self.library.zk_pairs(self._world, self.pair_count, address(first), address(second)):
            raise MemoryError
        self._scratch = self.library.zk_scratch(self._world)
        if not self._scratch:
            raise MemoryError
        self.library.zk_refresh(self._scratch)

    def __del__(self) -> None:
        if self._scratch:
            self.library.zk_scratch_free(self._scratch)
        if self._world:
            self.library.zk_free(self._world)

    def _add(self, item: pin.GeometryObject, shape: Shape) -> None:
        placement = np.ascontiguousarray(item.placement.homogeneous[:3])
        index = self.library.zk_add(
            self._world, shape.kind, item.parentJoint, address(shape.size), address(shape.points), len(shape.points),
            address(shape.sphere), address(placement),
        )
        if index < 0:
            raise NoKernel(f"{item.name}: the planning kernel takes no such shape")

    def place(self, index: int, pose: Array) -> None:
        """Put a shape at a (4, 4) pose in the frame of its joint; call `placed` after the last."""
        if not 0 <= index < self._shape_count:
            raise IndexError(f"there are {self._shape_count} shapes, none is number {index}")
        given = np.ascontiguousarray(pose[:3], dtype=float)
        with self._lock:
            self.library.zk_place(self._world, index, address(given))

    def set_points(self, index: int, spheres: Array) -> None:
        """Put spheres (N, 4), middle and radius [m] in the world, into a set of points; call `placed` after the last.

        Raises:
            ValueError: they are no spheres.
        """
        given = np.ascontiguousarray(spheres, dtype=float)
        if index not in self._points:
            raise IndexError(f"shape {index} is no set of points")
        if given.ndim != 2 or given.shape[1] != 4 or not (np.abs(given) < _LARGEST).all() or (given[:, 3] < 0).any():
            raise ValueError(f"spheres of shape {given.shape} have to be (N, 4), finite and of radius 0 or more")
        with self._lock:
            if not self.library.zk_points(self._world, index, len(given), address(given)):
                raise MemoryError

    def near(self, q: Array, margins: Array, points: Array) -> NDArray[np.bool_]:
        """(N,) which of points (N, 3), world, are no farther than a margin [m] from any shape with the robot at q.

        Args:
            margins: (shapes,) of each shape, EXCUSED for those that do not count.
        """
        given, least = self._q(q), np.ascontiguousarray(margins, dtype=float)
        at = np.ascontiguousarray(points, dtype=float)
        if at.ndim != 2 or at.shape[1] != 3 or least.shape != (self._shape_count,):
            raise ValueError(f"points have shape {at.shape}, margins {least.shape} for {self._shape_count} shapes")
        out = np.zeros(len(at), dtype=np.uint8)
        with self._lock:
            self.library.zk_near(self._scratch, address(given), address(least), len(at), address(at), address(out))
        return out.view(np.bool_)

    def placed(self) -> None:
        """Take over where obstacles stand now."""
        with self._lock:
            self.library.zk_refresh(self._scratch)

    def set_rules(
        self,
        far: Array,
        near: Array | None = None,
        tool: int = 0,
        tip: ArrayLike = (0, 0, 0),
        origin: ArrayLike = (0, 0, 0),
        leash: float = 0.0,
    ) -> None:
        """Set the least distance (pairs,) [m] of each pair, EXCUSED for none.

        Args:
            far: what holds in general.
            near: what holds while the tool point is within `leash` [m] of `origin` (3,), world.
            tool: joint that carries the tool point; tip: (3,) the point in that joint's frame.
        """
        arrays = [np.ascontiguousarray(a, dtype=float) for a in (far, tip, origin)]
        other = None if near is None else np.ascontiguousarray(near, dtype=float)
        if len(arrays[0]) != self.pair_count or (other is not None and len(other) != self.pair_count):
            raise ValueError(f"{len(arrays[0])} margins for {self.pair_count} pairs")
        with self._lock:
            self.library.zk_rules(
                self._world, address(arrays[0]), None if other is None else address(other), tool, address(arrays[1]),
                address(arrays[2]), leash,
            )

    def keep_to(
        self, tool: int, tip: ArrayLike, directions: ArrayLike, at: Array, n: Array, least: Array, slack: Array,
        inside: Array,
    ) -> None:
        """Set numbers n x - least (K,) that edges and paths keep from being negative, but for their slack (K,).

        Args:
            tool: joint that carries the tool; tip: (3,) the tool point in that joint's frame.
            directions: (K,) whether x is the direction `at` (K, 3), in that joint's frame, else the tool point.
            n: (K, 3) world.
            inside: (K,) where states are projected to: an angle [rad] between `at` and n, or n x - least [m].
        """
        arrays = [np.ascontiguousarray(a, dtype=float) for a in (at, n, least, slack, inside)]
        place, kinds = np.ascontiguousarray(tip, dtype=float), np.ascontiguousarray(directions, dtype=np.int32)
        with self._lock:
            if not self.library.zk_keep(
                self._world, len(kinds), tool, address(place), address(kinds), *(address(a) for a in arrays)
            ):
                raise ValueError(f"the planning kernel keeps to no {len(kinds)} numbers")

    def first_break(self, coefficients: Array, accepted: float, proved: float) -> tuple[int, float] | None:
        """The first of cubics (N, 4, dof), as below, at which what is kept to is broken, and t on it; None for none.

        Args:
            accepted: share of the slack that states may use; proved: what is proved between them.
        """
        given, where = self._cubics(coefficients), c_double()
        with self._lock:
            piece = int(
                self.library.zk_kept(self._scratch, len(given), address(given), accepted, proved, byref(where)))
        return None if piece < 0 else (piece, where.value)

    def colliding(self, q: Array) -> int:
        """Index of a pair that is too close at q (dof,) [rad], -1 when the robot is free."""
        given = self._q(q)
        with self._lock:
            return int(self.library.zk_state(self._scratch, address(given)))

    def edge_collision(self, a: Array, b: Array) -> tuple[int, float]:
        """A pair that is too close on the straight line in joint space from a to b, and where: 0 to 1.

        -1 when the whole line is proved free.
        """
        first, last, where = self._q(a), self._q(b), c_double()
        with self._lock:
            hit = int(self.library.zk_edge(self._scratch, address(first), address(last), byref(where)))
        return hit, where.value

    def edge_free(self, a: Array, b: Array) -> bool:
        """Whether the straight line in joint space from a to b (dof,) [rad] is proved free."""
        return self.edge_collision(a, b)[0] < 0

    def cubics_collision(self, coefficients: Array) -> tuple[int, float]:
        """The same for cubics (N, 4, dof), c0 + c1 t + c2 t^2 + c3 t^3 with t from 0 to 1: pair, piece + t."""
        given, where = self._cubics(coefficients), c_double()
        with self._lock:
            hit = int(self.library.zk_cubics(self._scratch, len(given), address(given), byref(where)))
        return hit, where.value

    def first_collision(self, path: Array) -> tuple[int, int]:
        """The first of positions (N, dof) [rad] that is not free, and a pair that is too close there; -1 for none."""
        given = np.ascontiguousarray(path, dtype=float)
        if given.ndim != 2 or given.shape[1] != self.dof:
            raise ValueError(f"positions have shape {given.shape}")
        pair = c_int()
        with self._lock:
            index = int(self.library.zk_first(self._scratch, len(given), address(given), byref(pair)))
        return index, pair.value

    def distances(self, q: Array) -> tuple[Array, Array]:
        """(pairs,) [m] how far apart points of each pair are at q, and how far a plane holds them apart.

        Both are the distance within rounding where shapes are apart. Where they are not the first is 0 or less.
        """
        given = self._q(q)
        above, below = np.empty(self.pair_count), np.empty(self.pair_count)
        with self._lock:
            self.library.zk_distances(self._scratch, address(given), address(above), address(below))
        return above, below

    def joint_poses(self, q: Array) -> Array:
        """(joints, 3, 4) poses of the joints' frames, world."""
        given, out = self._q(q), np.empty((self.dof, 3, 4))
        with self._lock:
            self.library.zk_forward(self._scratch, address(given), address(out))
        return out

    def counters(self) -> dict[str, int]:
        """How much was done so far."""
        out = np.zeros(5, dtype=np.int64)
        with self._lock:
            self.library.zk_counters(self._scratch, address(out))
        return dict(zip(("states", "looks", "searches", "iterations", "edges"), out.tolist(), strict=True))

    def plan(self, *arguments: object) -> int:
        """See zk_plan in kernel.c; `planner.find_path` asks it."""
        with self._lock:
            return int(self.library.zk_plan(self._scratch, *arguments))

    def _cubics(self, coefficients: Array) -> Array:
        given = np.ascontiguousarray(coefficients, dtype=float)
        if given.ndim != 3 or given.shape[1:] != (4, self.dof):
            raise ValueError(f"coefficients have shape {given.shape}")
        return given

    def _q(self, q: ArrayLike) -> Array:
        given = np.ascontiguousarray(q, dtype=float)
        if given.shape != (self.dof,):
            raise ValueError(f"joint positions have shape {given.shape}, not ({self.dof},)")
        return given


def address(array: NDArray[Any]) -> int:
    """Where the numbers of an array are; the array has to live as long as they are used."""
    return array.ctypes.data


def joints_of(model: pin.Model) -> tuple[CDLL, int]:
    """The library, and a world in it that has the model's joints and nothing else: to be freed with `zk_free`.

    Raises:
        NoKernel: there is no library, or a joint is not known to it.
    """
    found = library()
    if found is None:
        raise NoKernel("the planning kernel is not built")
    kinds, axes = _joints(model)
    parents = np.array(list(model.parents)[1:], dtype=np.int32)
    placements = np.array([placement.homogeneous[:3] for placement in list(model.jointPlacements)[1:]])
    lower, upper = (np.array(limit, dtype=float) for limit in (model.lowerPositionLimit, model.upperPositionLimit))
    world = found.zk_world(model.nq, *(address(a) for a in (parents, kinds, placements, axes, lower, upper)))
    if not world:
        raise NoKernel(f"the planning kernel takes 31 joints at most, not {model.nq}")
    return found, int(world)


def _joints(model: pin.Model) -> tuple[NDArray[np.int32], Array]:
    """Kind (joints,) of each joint, 1 turns and 2 slides, and its unit axis (joints, 3) in its own frame."""
    if model.nq != model.njoints - 1 or model.nv != model.nq:
        raise NoKernel("the planning kernel takes joints of one degree of freedom with limits")
    data = model.createData()
    jacobian = np.array(pin.computeJointJacobians(model, data, pin.neutral(model))).reshape(6, -1)
    kinds, axes = np.zeros(model.nq, dtype=np.int32), np.zeros((model.nq, 3))
    for joint in range(1, model.njoints):
        if model.joints[joint].shortname() not in _JOINTS:
            raise NoKernel(f"the planning kernel takes no {model.joints[joint].shortname()}")
        column = jacobian[:, model.joints[joint].idx_v]
        turns = np.linalg.norm(column[3:]) > 0.5
        axis = np.array(data.oMi[joint].rotation).T @ (column[3:] if turns else column[:3])
        kinds[joint - 1], axes[joint - 1] = (1 if turns else 2), axis / np.linalg.norm(axis)
        if model.joints[joint].idx_q != joint - 1:
            raise NoKernel("the planning kernel takes joints in the order of their positions")
    return kinds, axes


def _sphere(points: Array) -> Array:
    """(4,) middle and radius [m] of a small sphere about points (N, 3): Ritter's, then moved towards the farthest."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    best, least = middle, float(np.linalg.norm(points - middle, axis=1).max())
    for i in range(1, 200):  # Badoiu and Clarkson, "Smaller core-sets for spheres" (2003)
        away = np.linalg.norm(points - middle, axis=1)
        if away.max() < least:
            best, least = middle, float(away.max())
        middle = middle + (points[int(away.argmax())] - middle) / (i + 1)
    return np.array([*best, least * (1 + 1e-12)])
