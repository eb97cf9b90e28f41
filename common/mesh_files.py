"""Meshes from files, of every format that trimesh reads; one that cannot be read is told in a line."""

from __future__ import annotations

from collections.abc import Callable, Sized
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from common.errors import ConfigError

if TYPE_CHECKING:
    import trimesh

_SHOWN = 120  # characters of what the reader of a format says

T = TypeVar("T", bound=Sized)


def triangles_of(field: str, path: Path) -> NDArray[np.float64]:
    """(n, 3, 3) corners of all triangles of a file, in its own units.

    Raises:
        ConfigError: it cannot be read; names the field of the config that leads to it.
    """
    import trimesh  # takes a third of a second, and few need it

    return _read(field, path, lambda: np.array(trimesh.load_mesh(str(path), process=False).triangles, dtype=np.float64))


def parts_of(field: str, path: Path) -> list[trimesh.Trimesh]:
    """The meshes of a file with their materials, each where its scene has it.

    Raises:
        ConfigError: it cannot be read; names the field of the config that leads to it.
    """
    import trimesh

    return _read(field, path, lambda: [
        part for part in trimesh.load_scene(path).dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)])


def _read(field: str, path: Path, read: Callable[[], T]) -> T:
    try:
        found = read()
        if not len(found):
            raise ValueError("it has no triangles")  # as of a file that was cut off
        return found
    except Exception as error:  # each format's reader raises what it happens upon in a damaged file
        told = " ".join(str(error).split())[:_SHOWN] or type(error).__name__
        raise ConfigError(field, str(path), f"is a mesh that cannot be read: {told}") from None
