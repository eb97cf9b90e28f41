"""Files that can be computed again: they survive a restart and are shared by cells."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

CACHE_VARIABLE = "ZENCELL_CACHE"  # cache folder; default: zencell in the user's cache
_FORMAT = b"2"  # version of the cached format


def cache_folder() -> Path:
    """Return the cache folder, which need not exist."""
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zencell"


def cached_arrays(kind: str, content: Sequence[bytes], make: Callable[[], Arrays]) -> Arrays:
    """Return the cached arrays for the content, or compute them and cache them if possible."""
    if (found := find_arrays(kind, content)) is not None:
        return found
    arrays = make()
    save_arrays(kind, content, arrays)
    return arrays


def find_arrays(kind: str, content: Sequence[bytes]) -> Arrays | None:
    """Return the cached arrays for the content; None if there are none."""
    path = _path(kind, content)
    with contextlib.suppress(OSError, ValueError, EOFError, zipfile.BadZipFile), path.open("rb") as file:
        return dict(np.load(file, allow_pickle=False))
    return None


def save_arrays(kind: str, content: Sequence[bytes], arrays: Arrays) -> None:
    """Cache arrays for the content if possible; with a read-only folder they are computed again next time."""
    path = _path(kind, content)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, suffix=".npz")
        with os.fdopen(descriptor, "wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(name, path)


def _path(kind: str, content: Sequence[bytes]) -> Path:
    digest = hashlib.sha256(_FORMAT)
    for part in content:
        digest.update(len(part).to_bytes(8, "little") + part)
    return cache_folder() / "meshes" / f"{kind}-{digest.hexdigest()[:32]}.npz"
