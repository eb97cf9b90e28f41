"""Splits meshes into convex pieces, since MuJoCo lets only those collide.

A connected part of a mesh that is convex is one piece. A concave one is decomposed by CoACD (extra `meshes`) once; the
result is cached. Wei et al., "Approximate convex decomposition for 3D meshes with collision-aware concavity and tree
search" (2022). Where that is not installed or takes too long, the convex hull of the part collides, with a warning.

    python -m drivers.mujoco.decomposition FILE...    decomposes files ahead of time, however long each takes
"""

from __future__ import annotations

import io
import logging
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.cache import find_arrays, save_arrays

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Piece = Array  # triangles (n, 3, 3) [m]; the hull of their corners collides

CONCAVE = 0.03  # depth of a part's surface below its hull, by its length, beyond which it is decomposed
DEEP = 1e-3  # [m] depth below which it is not
BUDGET = 10.0  # [s] of a process for all decompositions: the executor has to be ready in 15 s
PATIENT = 300.0  # [s] for each mesh ahead of time
WORKER = Path(__file__).with_name("decomposition_worker.py")

LATER = "decompose it ahead of time by python -m drivers.mujoco.decomposition FILE"

_spent = 0.0  # [s] by this process


def mesh_pieces(triangles: Array, name: str, limit: float | None = None) -> list[Piece]:
    """Return the convex pieces of a mesh (n, 3, 3) [m].

    Args:
        triangles: the surface; parts that share no corner are separate.
        name: of the object, for warnings.
        limit: time for each decomposition [s]; None: what is left of the budget of this process.
    """
    found: list[Piece] = []
    for part in connected_parts(triangles):
        found += [part] if is_convex(part) else _decomposed(part, name, limit)
    return found


def connected_parts(triangles: Array) -> list[Array]:
    """Split triangles (n, 3, 3) into connected parts (k, 3, 3) of at least four distinct corners."""
    points, corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    corners = corners.reshape(-1, 3)
    lowest = np.arange(len(points))
    while True:
        least = lowest[corners].min(axis=1)
        before = lowest.copy()
        for column in range(3):
            np.minimum.at(lowest, corners[:, column], least)
        if (lowest == before).all():
            break
    label = lowest[corners[:, 0]]
    return [triangles[label == each] for each in np.unique(label) if (lowest == each).sum() >= 4]


def is_convex(part: Array) -> bool:
    """Whether each triangle of a connected part (n, 3, 3) [m] has all corners on one side, or close to its plane."""
    normals = np.cross(part[:, 1] - part[:, 0], part[:, 2] - part[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    sound = lengths > 1e-12
    if not sound.any():
        return True
    points = np.unique(part.reshape(-1, 3), axis=0)
    normals = normals[sound] / lengths[sound, None]
    ahead = points @ normals.T - (part[sound, 0] * normals).sum(axis=1)
    depth = float(np.minimum(ahead.max(axis=0), -ahead.min(axis=0)).max())  # normals may point inward
    return depth <= max(DEEP, CONCAVE * float(np.ptp(points, axis=0).max()))


def points_and_volume(piece: Piece) -> tuple[Array, float]:
    """Return the distinct points (n, 3) [m] of a closed convex piece, and its volume [m^3]."""
    points = np.unique(piece.reshape(-1, 3), axis=0)
    a, b, c = np.moveaxis(piece - points.mean(axis=0), 1, 0)
    return points, max(float(np.abs(np.einsum("ni,ni->n", a, np.cross(b, c))).sum()) / 6, 1e-12)


def _decomposed(part: Array, name: str, limit: float | None) -> list[Piece]:
    global _spent  # noqa: PLW0603
    content = [np.ascontiguousarray(part, "<f8").tobytes()]
    found = find_arrays("pieces", content)
    if found is None:
        why = "that needs the extra `meshes`: pip install 'zencell[meshes]'"
        if find_spec("coacd") is not None:
            seconds = max(BUDGET - _spent, 0.0) if limit is None else limit
            start = time.perf_counter()
            found, why = _run_worker(part, seconds)
            _spent += time.perf_counter() - start
        if found is None:
            log.warning("%s: its mesh is concave but collides as its convex hull: %s", name, why)
            return [part]
        save_arrays("pieces", content, found)
    return list(found.values())


def _run_worker(part: Array, seconds: float) -> tuple[dict[str, NDArray[np.float64]] | None, str]:
    """Return the arrays of the pieces; or None, and why."""
    if seconds < 1.0:
        return None, f"no time is left at the start; {LATER}"
    points, faces = np.unique(part.reshape(-1, 3), axis=0, return_inverse=True)
    given = io.BytesIO()
    np.savez(given, points=points, faces=faces.reshape(-1, 3).astype(np.int32))
    try:
        done = subprocess.run([sys.executable, str(WORKER)], input=given.getvalue(), capture_output=True,
                              timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return None, f"its decomposition takes more than {seconds:.0f} s; {LATER}"
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        return None, f"its decomposition fails: {''.join(last) or f'exit code {done.returncode}'}"
    return dict(np.load(io.BytesIO(done.stdout), allow_pickle=False)), ""


def main(files: list[str]) -> int:
    """Decompose the meshes of files; return the exit code."""
    from common.robot.mesh_files import triangles_of

    for file in files:
        start = time.perf_counter()
        pieces = mesh_pieces(triangles_of("file", Path(file)), file, PATIENT)
        print(f"{file}: {len(pieces)} pieces, {time.perf_counter() - start:.1f} s")  # noqa: T201
    return 0 if files else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
