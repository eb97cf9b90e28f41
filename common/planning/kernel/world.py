"""The robot among obstacles in the compiled kernel, built from pinocchio's models."""

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

CONTACT_ALLOWED = -1e9  # [m] margin of a pair that may touch
_SPHERE, _BOX, _CYLINDER, _CAPSULE, _HULL, _POINTS = range(6)
_LARGEST = 1e7  # [m] larger shapes would suffer from rounding
_JOINTS = (
    *(f"JointModel{kind}{axis}" for kind in "RP" for axis in "XYZ"),
    *(f"JointModel{kind}Unaligned" for kind in ("Revolute", "Prismatic")),
)


class KernelUnavailable(ZencellError):
    """The kernel is not built, or does not support a joint or a shape."""


@dataclass(frozen=True)
class Shape:
    """A shape for the kernel: kind, dimensions (3,), vertices (N, 3) of a hull and a sphere (4,) about them."""

    kind: int
    size: Array
    points: Array
    sphere: Array

    @classmethod
    def of(cls, shape: coal.CollisionGeometry) -> Shape:
        """Convert a coal shape.

        Raises:
            KernelUnavailable: the kernel does not support it.
        """
        if isinstance(shape, coal.ShapeBase) and shape.getSweptSphereRadius() > 0:
            raise KernelUnavailable(f"the planning kernel supports no {type(shape).__name__} with a swept sphere")
        found = cls._converted(shape)
        if not (np.abs(found.size) < _LARGEST).all() or not (np.abs(found.points) < _LARGEST).all():
            raise KernelUnavailable(f"the planning kernel takes no {type(shape).__name__} larger than {_LARGEST:g} m")
        return found

    @classmethod
    def _converted(cls, shape: coal.CollisionGeometry) -> Shape:
        no_points, no_sphere = np.zeros((0, 3)), np.zeros(4)
        if isinstance(shape, coal.Sphere):
            return cls(_SPHERE, np.array([shape.radius, 0, 0]), no_points, no_sphere)
        if isinstance(shape, coal.Box):
            return cls(_BOX, 2 * np.array(shape.halfSide), no_points, no_sphere)
        if isinstance(shape, coal.Cylinder | coal.Capsule):
            kind = _CYLINDER if isinstance(shape, coal.Cylinder) else _CAPSULE
            return cls(kind, np.array([shape.radius, 2 * shape.halfLength, 0]), no_points, no_sphere)
        if isinstance(shape, coal.Convex):
            points = np.array([shape.point(i) for i in range(shape.num_points)], dtype=float)
            return cls(_HULL, np.zeros(3), points, _sphere(points))
        raise KernelUnavailable(f"the planning kernel does not support a {type(shape).__name__}")


class KernelWorld:
    """The compiled kernel for one robot among obstacles. Thread-safe: one call runs at a time.

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
            known: the first of the shapes, if converted before: reading a hull takes a millisecond.
            points: shapes of the environment that stand for sets of points, empty until `set_points`; paired with
                moving shapes only.

        Raises:
            KernelUnavailable: the library is missing, or the kernel does not support a joint or a shape.
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
            raise KernelUnavailable(f"{item.name}: the planning kernel does not support this shape")

    def set_pose(self, index: int, pose: Array) -> None:
        """Set the (4, 4) pose of a shape in the frame of its joint; call `refresh` after the last."""
        if not 0 <= index < self._shape_count:
            raise IndexError(f"shape {index} does not exist; there are {self._shape_count}")
        rows = np.ascontiguousarray(pose[:3], dtype=float)
        with self._lock:
            self.library.zk_place(self._world, index, address(rows))

    def set_points(self, index: int, spheres: Array) -> None:
        """Set the spheres (N, 4), centre and radius [m], world, of a set of points; call `refresh` after the last.

        Raises:
            ValueError: they are no spheres.
        """
        given = np.ascontiguousarray(spheres, dtype=float)
        if index not in self._points:
            raise IndexError(f"shape {index} is not a point set: only add_points() creates one")
        if given.ndim != 2 or given.shape[1] != 4 or not (np.abs(given) < _LARGEST).all() or (given[:, 3] < 0).any():
            raise ValueError(f"spheres of shape {given.shape} must be (N, 4), finite and of radius 0 or more")
        with self._lock:
            if not self.library.zk_points(self._world, index, len(given), address(given)):
                raise MemoryError

    def near(self, q: Array, margins: Array, points: Array) -> NDArray[np.bool_]:
        """Return (N,) which of points (N, 3), world, are within a margin [m] of any shape with the robot at q.

        Args:
            margins: (shapes,) of each shape, CONTACT_ALLOWED for those to ignore.
        """
        given, least = self._q(q), np.ascontiguousarray(margins, dtype=float)
        at = np.ascontiguousarray(points, dtype=float)
        if at.ndim != 2 or at.shape[1] != 3 or least.shape != (self._shape_count,):
            raise ValueError(f"points have shape {at.shape}, margins {least.shape} for {self._shape_count} shapes")
        out = np.zeros(len(at), dtype=np.uint8)
        with self._lock:
            self.library.zk_near(self._scratch, address(given), address(least), len(at), address(at), address(out))
        return out.view(np.bool_)

    def refresh(self) -> None:
        """Apply the poses and points that were set."""
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
        """Set the required distance (pairs,) [m] of each pair, CONTACT_ALLOWED for none.

        Args:
            far: in general.
            near: while the tool point is within `leash` [m] of `origin` (3,), world.
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

    def set_bounds(
        self, tool: int, tip: ArrayLike, directions: ArrayLike, at: Array, n: Array, least: Array, slack: Array,
        inside: Array,
    ) -> None:
        """Set numbers n x - least (K,) that must not be negative along edges and paths, up to their slack (K,).

        Args:
            tool: joint that carries the tool; tip: (3,) the tool point in that joint's frame.
            directions: (K,) whether x is the direction `at` (K, 3), in that joint's frame, else the tool point.
            n: (K, 3) world.
            inside: (K,) where states are projected to: an angle [rad] between `at` and n, or n x - least [m].

        Raises:
            ValueError: there are too many.
        """
        arrays = [np.ascontiguousarray(a, dtype=float) for a in (at, n, least, slack, inside)]
        place, kinds = np.ascontiguousarray(tip, dtype=float), np.ascontiguousarray(directions, dtype=np.int32)
        with self._lock:
            if not self.library.zk_keep(
                self._world, len(kinds), tool, address(place), address(kinds), *(address(a) for a in arrays)
            ):
                raise ValueError(f"the planning kernel does not support {len(kinds)} bounds")

    def first_violation(self, coefficients: Array, accepted: float, proved: float) -> tuple[int, float] | None:
        """Return the first of cubics (N, 4, dof), as below, that violates a bound, and t on it; None for none.

        Args:
            accepted: share of the slack that states may use; proved: share that is proved between them.
        """
        given, where = self._cubics(coefficients), c_double()
        with self._lock:
            piece = int(
                self.library.zk_kept(self._scratch, len(given), address(given), accepted, proved, byref(where)))
        return None if piece < 0 else (piece, where.value)

    def colliding(self, q: Array) -> int:
        """Return the index of a pair that is too close at q (dof,) [rad], -1 if the robot is free."""
        given = self._q(q)
        with self._lock:
            return int(self.library.zk_state(self._scratch, address(given)))

    def edge_collision(self, a: Array, b: Array) -> tuple[int, float]:
        """Return a pair that is too close on the straight line in joint space from a to b, and where: 0 to 1.

        The pair is -1 if the complete line is proved free.
        """
        first, last, where = self._q(a), self._q(b), c_double()
        with self._lock:
            hit = int(self.library.zk_edge(self._scratch, address(first), address(last), byref(where)))
        return hit, where.value

    def edge_free(self, a: Array, b: Array) -> bool:
        """Return whether the straight line in joint space from a to b (dof,) [rad] is proved free."""
        return self.edge_collision(a, b)[0] < 0

    def cubics_collision(self, coefficients: Array) -> tuple[int, float]:
        """Return the same for cubics (N, 4, dof), c0 + c1 t + c2 t^2 + c3 t^3 with t from 0 to 1: pair, piece + t."""
        given, where = self._cubics(coefficients), c_double()
        with self._lock:
            hit = int(self.library.zk_cubics(self._scratch, len(given), address(given), byref(where)))
        return hit, where.value

    def first_collision(self, path: Array) -> tuple[int, int]:
        """Return the first of positions (N, dof) [rad] that is not free, and a pair too close there; -1 for none."""
        given = np.ascontiguousarray(path, dtype=float)
        if given.ndim != 2 or given.shape[1] != self.dof:
            raise ValueError(f"positions have shape {given.shape}")
        pair = c_int()
        with self._lock:
            index = int(self.library.zk_first(self._scratch, len(given), address(given), byref(pair)))
        return index, pair.value

    def distances(self, q: Array) -> tuple[Array, Array]:
        """Return (pairs,) [m] an upper and a lower bound of each distance at q: by a pair of points, and by a plane.

        Both are the distance within rounding where shapes are apart; otherwise the first is 0 or less.
        """
        given = self._q(q)
        above, below = np.empty(self.pair_count), np.empty(self.pair_count)
        with self._lock:
            self.library.zk_distances(self._scratch, address(given), address(above), address(below))
        return above, below

    def joint_poses(self, q: Array) -> Array:
        """Return (joints, 3, 4) poses of the joints' frames, world."""
        given, out = self._q(q), np.empty((self.dof, 3, 4))
        with self._lock:
            self.library.zk_forward(self._scratch, address(given), address(out))
        return out

    def counters(self) -> dict[str, int]:
        """Return how much was computed so far."""
        out = np.zeros(5, dtype=np.int64)
        with self._lock:
            self.library.zk_counters(self._scratch, address(out))
        return dict(zip(("states", "checks", "searches", "iterations", "edges"), out.tolist(), strict=True))

    def plan(self, *arguments: object) -> int:
        """Call zk_plan of kernel.c; used by `solvers.find_path`."""
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
    """Return the address of an array's data; the array must outlive its use."""
    return array.ctypes.data


def joints_of(model: pin.Model) -> tuple[CDLL, int]:
    """Return the library, and a world in it with only the model's joints, to be freed with `zk_free`.

    Raises:
        KernelUnavailable: the library is missing, or the kernel does not support a joint.
    """
    found = library()
    if found is None:
        raise KernelUnavailable("the planning kernel is not built")
    kinds, axes = _joints(model)
    parents = np.array(list(model.parents)[1:], dtype=np.int32)
    placements = np.array([placement.homogeneous[:3] for placement in list(model.jointPlacements)[1:]])
    lower, upper = (np.array(limit, dtype=float) for limit in (model.lowerPositionLimit, model.upperPositionLimit))
    world = found.zk_world(model.nq, *(address(a) for a in (parents, kinds, placements, axes, lower, upper)))
    if not world:
        raise KernelUnavailable(f"the planning kernel supports at most 31 joints, not {model.nq}")
    return found, int(world)


def _joints(model: pin.Model) -> tuple[NDArray[np.int32], Array]:
    """Return kind (joints,), 1 revolute and 2 prismatic, and unit axis (joints, 3) of each joint in its own frame."""
    if model.nq != model.njoints - 1 or model.nv != model.nq:
        raise KernelUnavailable("the planning kernel supports joints of one degree of freedom with limits only")
    data = model.createData()
    jacobian = np.array(pin.computeJointJacobians(model, data, pin.neutral(model))).reshape(6, -1)
    kinds, axes = np.zeros(model.nq, dtype=np.int32), np.zeros((model.nq, 3))
    for joint in range(1, model.njoints):
        if model.joints[joint].shortname() not in _JOINTS:
            raise KernelUnavailable(f"the planning kernel does not support a {model.joints[joint].shortname()}")
        column = jacobian[:, model.joints[joint].idx_v]
        turns = np.linalg.norm(column[3:]) > 0.5
        axis = np.array(data.oMi[joint].rotation).T @ (column[3:] if turns else column[:3])
        kinds[joint - 1], axes[joint - 1] = (1 if turns else 2), axis / np.linalg.norm(axis)
        if model.joints[joint].idx_q != joint - 1:
            raise KernelUnavailable("the planning kernel needs joints in the order of their positions")
    return kinds, axes


def _sphere(points: Array) -> Array:
    """Return (4,) centre and radius [m] of a small sphere about points (N, 3), moved towards the farthest point."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    best, least = middle, float(np.linalg.norm(points - middle, axis=1).max())
    for i in range(1, 200):  # Badoiu and Clarkson, "Smaller core-sets for spheres" (2003)
        away = np.linalg.norm(points - middle, axis=1)
        if away.max() < least:
            best, least = middle, float(away.max())
        middle = middle + (points[int(away.argmax())] - middle) / (i + 1)
    return np.array([*best, least * (1 + 1e-12)])
