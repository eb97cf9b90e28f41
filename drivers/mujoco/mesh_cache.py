"""Meshes of a robot for MuJoCo, cached in files by content hash."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from common.robot.mesh_files import triangles_of
from common.robot.model import RobotModel

CACHE_VARIABLE = "ZENCELL_CACHE"  # cache folder; default: zencell in the user's cache
_FORMAT = b"1"  # version of the cached format
if TYPE_CHECKING:
    from common.robot.visual_meshes import Piece

Arrays = dict[str, NDArray[Any]]


def cache_folder() -> Path:
    """Return the cache folder, which need not exist."""
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zencell"


def hull_points(path: Path) -> NDArray[np.float64]:
    """(n, 3) distinct vertices of a mesh file in its units; their convex hull is the collision shape.

    Raises:
        ConfigError: the file cannot be read.
    """
    def read() -> Arrays:
        return {"points": np.unique(triangles_of("robot.urdf", path).reshape(-1, 3), axis=0)}

    return cached_arrays("hull", [path.read_bytes()], read)["points"]


def cached_visual_meshes(robot: RobotModel, triangles: int) -> list[Piece]:
    """Visual meshes of all links, simplified to about this many triangles: see `common.robot.visual_meshes`."""
    from common.robot.visual_meshes import Piece, visible_shapes, visual_pieces  # imports trimesh

    files = [shape.path.read_bytes() for shape in visible_shapes(robot) if shape.path is not None]

    def make() -> Arrays:
        arrays: Arrays = {}
        for number, piece in enumerate(visual_pieces(robot, triangles)):
            red, green, blue = piece.color
            name = f"{number}|{piece.link}|{red}|{green}|{blue}"
            arrays[f"{name}|vertices"], arrays[f"{name}|faces"] = piece.vertices, piece.faces
        return arrays

    found = cached_arrays("visual", [robot.urdf.encode(), str(triangles).encode(), *files], make)
    pieces = {}
    for name, vertices in found.items():
        number, link, red, green, blue, what = name.split("|")
        if what == "vertices":
            faces = found[name.removesuffix(what) + "faces"]
            pieces[int(number)] = Piece(link, (int(red), int(green), int(blue)), vertices, faces)
    return [pieces[number] for number in sorted(pieces)]


def cached_arrays(kind: str, content: list[bytes], make: Callable[[], Arrays]) -> Arrays:
    """Return the cached arrays for the content, or compute them and cache them if possible."""
    digest = hashlib.sha256(_FORMAT)
    for part in content:
        digest.update(len(part).to_bytes(8, "little") + part)
    path = cache_folder() / "meshes" / f"{kind}-{digest.hexdigest()[:32]}.npz"
    with contextlib.suppress(OSError, ValueError, EOFError, zipfile.BadZipFile), path.open("rb") as file:
        return dict(np.load(file, allow_pickle=False))
    arrays = make()
    with contextlib.suppress(OSError):  # read-only folder: computed again next time
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, suffix=".npz")
        with os.fdopen(descriptor, "wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(name, path)
    return arrays
