"""Paths by the kernel's RRT-Connect, shortened: every edge is proved free."""

from __future__ import annotations

import ctypes
from ctypes import byref
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.planning.kernel.world import KernelWorld, address

Array = NDArray[np.float64]

_MOST_WAYPOINTS = 2000
_REASONS = {-1: "no_path", -2: "timeout", -3: "cancelled", -4: "no_path"}


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
class Found:
    """What a search came to: waypoints (N, dof) [rad], or the reason for none.

    `from_start` of the `nodes` can be reached from the start, the others lead to the goals.
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
) -> Found:
    """A path from start (dof,) to one of the goals (N, dof), all free [rad]; other threads run meanwhile.

    Args:
        seconds: wall time for all of it.
        reach: longest edge of the trees [rad].
        nodes: of both trees at most.
        shortcuts: tries at most; patience: tries that fail in a row before the shortening ends.
        cancel: ends the search once another thread makes it something else than 0.
    """
    options = _Options(reach, seconds, nodes, shortcuts, patience, seed)
    report = _Report()
    path = np.empty((_MOST_WAYPOINTS, world.dof))
    first, last = np.ascontiguousarray(start, dtype=float), np.ascontiguousarray(goals, dtype=float)
    if first.shape != (world.dof,) or last.ndim != 2 or last.shape[1] != world.dof or not len(last):
        raise ValueError(f"start has shape {first.shape}, goals {last.shape}")
    count = world.plan(
        address(first), len(last), address(last), byref(options), None if cancel is None else byref(cancel), len(path),
        address(path), byref(report),
    )
    return Found(
        path[:count].copy() if count > 0 else None,
        _REASONS.get(count, ""),
        report.samples,
        report.nodes,
        report.from_start,
        report.shortcuts,
        report.search_seconds,
        report.shorten_seconds,
    )
