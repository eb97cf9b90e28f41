"""Folder of files that can be computed again."""

from __future__ import annotations

import os
from pathlib import Path

CACHE_VARIABLE = "ZENCELL_CACHE"  # cache folder; default: zencell in the user's cache


def cache_folder() -> Path:
    """Return the cache folder, which need not exist."""
    if named := os.environ.get(CACHE_VARIABLE):
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "zencell"
