"""Objects from meshes of others: a folder of .obj, .stl, .ply or .urdf files, scaled to a size that fingers can grasp.

    python -m applications.sorting.objects.others FOLDER    reads and decomposes all of them ahead of time
"""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import numpy.typing as npt

from applications.sorting.objects.kinds import (
    FRICTIONS,
    LONGEST,
    MASSES,
    WIDEST,
    DrawnObject,
    Range,
    finished,
)
from common.errors import ConfigError
from common.robot.mesh_files import triangles_of
from common.robot.transforms import rpy_to_matrix

Array = npt.NDArray[np.float64]

FIELD = "world.generator.meshes"
SUFFIXES = (".obj", ".stl", ".ply")
MOST_FILES = 5000
MOST_PARTS = 60  # more of them double the time of a step
MOST_TRIANGLES = 1000  # a mesh with more of them is simplified
PATIENT = 300.0  # [s] for each mesh ahead of time


def mesh_files(folder: Path) -> list[Path]:
    """Return the files of objects in a folder and those below it, sorted; no meshes next to a URDF.

    Raises:
        ConfigError: it is no folder, or has no such files.
    """
    if not folder.is_dir():
        raise ConfigError(FIELD, str(folder), "is not a folder")
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (*SUFFIXES, ".urdf"))[:MOST_FILES]
    described = {path.parent for path in found if path.suffix.lower() == ".urdf"}
    files = [path for path in found if path.suffix.lower() == ".urdf" or path.parent not in described]
    if not files:
        raise ConfigError(FIELD, str(folder), f"has no meshes; choices: {', '.join((*SUFFIXES, '.urdf'))}")
    return files


def from_file(
    path: Path, rng: np.random.Generator, masses: Range = MASSES, frictions: Range = FRICTIONS,
    limit: float | None = None,
) -> DrawnObject:
    """Return the object in a file, with a random mass, friction and color.

    Args:
        path: of a mesh or a URDF.
        rng: source of what is random.
        masses: smallest and largest [kg].
        frictions: smallest and largest coefficient of sliding friction.
        limit: time to decompose each concave part [s]; by default what is left of that of this process.

    Raises:
        ConfigError: it cannot be read, or has too many parts.
    """
    from drivers.mujoco.decomposition import connected_parts, mesh_pieces

    surface = load(path)
    if (count := len(connected_parts(surface))) > MOST_PARTS:
        raise ConfigError(FIELD, str(path), f"has {count} separate parts; at most {MOST_PARTS} are simulated")
    pieces = mesh_pieces(surface, path.stem, limit)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem)[:40]
    return finished(pieces, name, rng, masses, frictions, surface)


def load(path: Path) -> Array:
    """Return the surface (n, 3, 3) [m] of the object in a file, about the middle of its bounding box, graspable.

    Raises:
        ConfigError: it cannot be read, or has no extent.
    """
    triangles = _of_urdf(path) if path.suffix.lower() == ".urdf" else triangles_of(FIELD, path)
    points = triangles.reshape(-1, 3)
    size = np.sort(np.ptp(points, axis=0))
    if not size[0] > 1e-3 * size[2] > 0:
        raise ConfigError(FIELD, str(path), "is a mesh without a volume")
    if len(triangles) > MOST_TRIANGLES:
        triangles = _simplified(triangles)
    scale = 1.0 if LONGEST[0] <= size[2] <= LONGEST[1] else 0.9 * LONGEST[1] / size[2]
    scale = min(scale, WIDEST / size[0])
    return np.asarray(scale * (triangles - (points.min(axis=0) + points.max(axis=0)) / 2))


def _simplified(triangles: Array) -> Array:
    import fast_simplification

    points, faces = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    points, faces = fast_simplification.simplify(
        points.astype(np.float32), faces.reshape(-1, 3).astype(np.int32), target_count=MOST_TRIANGLES)
    return np.asarray(np.asarray(points, float)[faces])


def _of_urdf(path: Path) -> Array:
    """Surface (n, 3, 3) [m] of the collision meshes of the first link of a URDF.

    Raises:
        ConfigError: it is no URDF, or its first link has no mesh.
    """
    try:
        root = ET.fromstring(path.read_bytes())
    except (ET.ParseError, OSError) as error:
        raise ConfigError(FIELD, str(path), f"cannot be read: {error}") from None
    link = root.find("link")
    found = []
    for shape in link.findall("collision") if link is not None else []:
        mesh, origin = shape.find("geometry/mesh"), shape.find("origin")
        if mesh is None:
            continue
        scale = np.array(mesh.get("scale", "1 1 1").split(), float)
        triangles = scale * triangles_of(FIELD, path.parent / str(mesh.get("filename")).removeprefix("package://"))
        if origin is not None:
            rpy = [float(value) for value in origin.get("rpy", "0 0 0").split()]
            shift = np.array(origin.get("xyz", "0 0 0").split(), float)
            triangles = triangles @ rpy_to_matrix(*rpy).T + shift
        found.append(triangles)
    if not found:
        raise ConfigError(FIELD, str(path), "has no link with a collision mesh")
    return np.concatenate(found)


def main(folders: list[str]) -> int:
    """Read and decompose the meshes of folders; return the exit code."""
    for folder in folders:
        for path in mesh_files(Path(folder)):
            try:
                drawn = from_file(path, np.random.default_rng(0), limit=PATIENT)
                text = f"{len(drawn.parts)} pieces"
            except ConfigError as error:
                text = f"left out: {error}"
            print(f"{path}: {text}")  # noqa: T201
    return 0 if folders else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
