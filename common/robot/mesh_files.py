"""Meshes from files of every format that trimesh reads; an unreadable one raises an error of one line."""

from __future__ import annotations

from collections.abc import Callable, Sized
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from common.errors import ConfigError

if TYPE_CHECKING:
    import trimesh

_MAX_SHOWN = 120  # characters of a reader's error

T = TypeVar("T", bound=Sized)


def triangles_of(field: str, path: Path) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of all triangles of a file, in its own units.

    Raises:
        ConfigError: the file is unreadable; names the configuration field that refers to it.
    """
    import trimesh  # takes a third of a second to import

    return _read(field, path, lambda: np.array(trimesh.load_mesh(str(path), process=False).triangles, dtype=np.float64))


def parts_of(field: str, path: Path) -> list[trimesh.Trimesh]:
    """Return the meshes of a file with their materials, each posed as in its scene.

    Raises:
        ConfigError: the file is unreadable; names the configuration field that refers to it.
    """
    import trimesh

    return _read(field, path, lambda: [
        part for part in trimesh.load_scene(path).dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)])


def _read(field: str, path: Path, read: Callable[[], T]) -> T:
    try:
        found = read()
        if not len(found):
            raise ValueError("it has no triangles")  # for example a truncated file
        return found
    except Exception as error:  # the readers of the formats raise any exception on a damaged file
        reason = " ".join(str(error).split())[:_MAX_SHOWN] or type(error).__name__
        raise ConfigError(field, str(path), f"is a mesh that cannot be read: {reason}") from None
