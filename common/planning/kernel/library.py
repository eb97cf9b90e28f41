"""The kernel's shared library: next to this file, loaded once, in the variant for this processor."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import c_double, c_int, c_uint64, c_void_p
from functools import cache
from pathlib import Path

from common.planning.kernel.build import FOLDER, NAME

VERSION = 11

_SIGNATURES: dict[str, tuple[object, list[object]]] = {
    "zk_version": (c_int, []),
    "zk_has_avx2": (c_int, []),
    "zk_world": (c_void_p, [c_int] + [c_void_p] * 6),
    "zk_add": (c_int, [c_void_p, c_int, c_int, c_void_p, c_void_p, c_int, c_void_p, c_void_p]),
    "zk_points": (c_int, [c_void_p, c_int, c_int, c_void_p]),
    "zk_thin": (c_int, [c_int, c_void_p, c_void_p, c_double, c_void_p]),
    "zk_near": (None, [c_void_p, c_void_p, c_void_p, c_int, c_void_p, c_void_p]),
    "zk_place": (None, [c_void_p, c_int, c_void_p]),
    "zk_pairs": (c_int, [c_void_p, c_int, c_void_p, c_void_p]),
    "zk_rules": (None, [c_void_p, c_void_p, c_void_p, c_int, c_void_p, c_void_p, c_double]),
    "zk_keep": (c_int, [c_void_p, c_int, c_int, *[c_void_p] * 7]),
    "zk_kept": (c_int, [c_void_p, c_int, c_void_p, c_double, c_double, c_void_p]),
    "zk_free": (None, [c_void_p]),
    "zk_scratch": (c_void_p, [c_void_p]),
    "zk_scratch_free": (None, [c_void_p]),
    "zk_refresh": (None, [c_void_p]),
    "zk_state": (c_int, [c_void_p, c_void_p]),
    "zk_edge": (c_int, [c_void_p] * 4),
    "zk_cubics": (c_int, [c_void_p, c_int, c_void_p, c_void_p]),
    "zk_first": (c_int, [c_void_p, c_int, c_void_p, c_void_p]),
    "zk_distances": (None, [c_void_p] * 4),
    "zk_forward": (None, [c_void_p] * 3),
    "zk_plan": (c_int, [c_void_p, c_void_p, c_int, c_void_p, c_void_p, c_void_p, c_int, c_void_p, c_void_p]),
    "zk_speeds": (c_int, [c_int, c_int] + [c_void_p] * 7),
    "zk_ik": (c_int, [c_void_p, c_int, c_void_p, c_void_p, c_void_p, c_int, c_int, c_uint64, c_void_p]),
    "zk_counters": (None, [c_void_p] * 2),
}


def _open(path: Path) -> ctypes.CDLL | None:
    try:
        found = ctypes.CDLL(str(path))
    except OSError:
        return None
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(found, name, None)
        if function is None:
            return None
        function.restype, function.argtypes = result, arguments
    return found if found.zk_version() == VERSION else None


def library_path() -> Path | None:
    """Return the file that `library` loads, or None."""
    found = library()
    return None if found is None else Path(found._name)


_disabled: list[bool] = []  # one entry for each active `without_kernel`


def library() -> ctypes.CDLL | None:
    """Return the library, or None if it was not built, cannot be loaded or has another version."""
    return None if _disabled else _load()


@contextmanager
def without_kernel() -> Iterator[None]:
    """Compute without the kernel meanwhile, as where it was not built: for tests and comparisons."""
    _disabled.append(True)
    try:
        yield
    finally:
        _disabled.pop()


@cache
def _load() -> ctypes.CDLL | None:
    plain = _open(FOLDER / f"{NAME}.so")
    if plain is None or not plain.zk_has_avx2():
        return plain
    return _open(FOLDER / f"{NAME}_avx2.so") or plain
