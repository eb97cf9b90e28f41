"""Solvers of the compiled kernel: inverse kinematics, path search and the fastest speeds along a path."""

from __future__ import annotations

import ctypes
from ctypes import byref
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.planning.kernel.library import library
from common.planning.kernel.world import KernelUnavailable, KernelWorld, address, joints_of

Array = NDArray[np.float64]

_MAX_WAYPOINTS = 2000
_REASONS = {-1: "no_path", -2: "timeout", -3: "cancelled", -4: "no_path"}


class KernelArm:
    """Inverse kinematics of the chain of joints that carries a frame. Safe for several threads at once."""

    def __init__(self, model: pin.Model, frame: int, position_tolerance: float, rotation_tolerance: float) -> None:
        """Copy joints and limits.

        Args:
            model: joints; frame: index of the frame to be positioned.
            position_tolerance: [m]; rotation_tolerance: [rad].

        Raises:
            KernelUnavailable: the library is missing, or the kernel does not support a joint.
        """
        self._world = None
        self._library, self._world = joints_of(model)
        self._joint: int = model.frames[frame].parentJoint
        if not self._joint:
            raise KernelUnavailable("no joint moves the frame")
        self._tip = np.array(model.frames[frame].placement.homogeneous[:3])
        self._tolerance = np.array([position_tolerance, rotation_tolerance])
        self._fixed = (self._world, self._joint, address(self._tip), address(self._tolerance))
        self._shape = (model.nq,)

    def __del__(self) -> None:
        if self._world:
            self._library.zk_free(self._world)

    def solve(
        self, T_world_frame: ArrayLike, seed: ArrayLike, *, restarts: int, iterations: int, random: int = 0
    ) -> Array | None:
        """Return joint positions (dof,) [rad] within the limits with the frame at a (4, 4) pose; None if none found.

        Args:
            seed: (dof,) [rad] where the search starts, clipped to the limits.
            restarts: random starts after that, seeded by `random`; iterations: steps from the seed.
        """
        pose, q = np.asarray(T_world_frame, dtype=float), np.array(seed, dtype=float, order="C")
        if pose.shape != (4, 4) or q.shape != self._shape:
            raise ValueError(f"pose has shape {pose.shape}, seed {q.shape}")
        target = np.ascontiguousarray(pose[:3])
        starts = self._library.zk_ik(*self._fixed, address(target), restarts, iterations, random, address(q))
        return None if starts < 0 else q


class _Options(ctypes.Structure):
    _fields_ = [
        ("range", ctypes.c_double),
        ("seconds", ctypes.c_double),
        ("nodes", ctypes.c_longlong),
        ("shortcuts", ctypes.c_longlong),
        ("patience", ctypes.c_longlong),
        ("seed", ctypes.c_uint64),
    ]


class _Report(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_longlong) for name in ("samples", "nodes", "from_start", "shortcuts", "shortened")),
        *((name, ctypes.c_double) for name in ("search_seconds", "shorten_seconds")),
    ]


@dataclass(frozen=True)
class SearchResult:
    """Waypoints (N, dof) [rad] of a path, or the error; and what the search did.

    `from_start` of the `nodes` belong to the tree at the start, the others to the tree at the goals.
    """

    waypoints: Array | None
    error: str
    samples: int
    nodes: int
    from_start: int
    shortcuts: int
    search_seconds: float
    shorten_seconds: float


def find_path(
    world: KernelWorld,
    start: Array,
    goals: Array,
    *,
    seed: int = 0,
    seconds: float = 10.0,
    reach: float = 1.0,
    nodes: int = 1_000_000,
    shortcuts: int = 300,
    patience: int = 60,
    cancel: ctypes.c_int | None = None,
) -> SearchResult:
    """Return a shortened RRT-Connect path from start (dof,) to one of the goals (N, dof) [rad].

    Every edge is proved free. Start and goals must be free. Other threads run meanwhile.

    Args:
        seconds: wall time for search and shortening.
        reach: longest edge of the trees [rad].
        nodes: limit of both trees together.
        shortcuts: limit of shortcut attempts; patience: failed attempts in a row that end the shortening.
        cancel: ends the search once another thread sets it to a value other than 0.
    """
    options = _Options(reach, seconds, nodes, shortcuts, patience, seed)
    report = _Report()
    path = np.empty((_MAX_WAYPOINTS, world.dof))
    first, last = np.ascontiguousarray(start, dtype=float), np.ascontiguousarray(goals, dtype=float)
    if first.shape != (world.dof,) or last.ndim != 2 or last.shape[1] != world.dof or not len(last):
        raise ValueError(f"start has shape {first.shape}, goals {last.shape}")
    count = world.plan(
        address(first), len(last), address(last), byref(options), None if cancel is None else byref(cancel), len(path),
        address(path), byref(report),
    )
    return SearchResult(
        path[:count].copy() if count > 0 else None, _REASONS.get(count, ""), report.samples, report.nodes,
        report.from_start, report.shortcuts, report.search_seconds, report.shorten_seconds,
    )


def fastest_speeds(
    lengths: Array, up: Array, down: Array, slope: Array, most: Array
) -> tuple[Array, Array] | int | None:
    """Return x (N + 1,) at the grid points and u (N,) between them, with -down - slope x <= u <= up - slope x.

    Where no such speeds exist, return the grid point from which the next cannot be reached, or N plus the grid point
    that cannot be left. Return None where the kernel is not built.

    Args:
        lengths: (N,); up, down, slope: (N, rows); most: (N + 1,) upper bounds of x.
    """
    found = library()
    if found is None:
        return None
    count, rows = up.shape
    arrays = [np.ascontiguousarray(values, dtype=float) for values in (lengths, up, down, slope)]
    highest, x, u = np.array(most, dtype=float), np.empty(count + 1), np.empty(count)
    failed = int(found.zk_speeds(count, rows, *(address(values) for values in (*arrays, highest, x, u))))
    return (x, u) if failed < 0 else failed
