"""Names that have moved: each can be imported from where it was for one version more, with a warning."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import Any


def moved_to(module: str, new: str) -> Callable[[str], Any]:
    """The `__getattr__` of a module whose names are all in another one now."""

    def find(name: str) -> Any:
        if name.startswith("_"):  # such as __path__, which Python asks for: only what is missing gets here
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        found = getattr(importlib.import_module(new), name)
        _warn(f"{module}.{name}", f"{new}.{name}")
        return found

    return find


def moved_to_applications(module: str, part: str) -> Callable[[str], Any]:
    """The `__getattr__` of a module of the platform, some names of which are in a part of an application now."""

    def find(name: str) -> Any:
        # Found by name and only now: applications are made of what this module has.
        for application in importlib.import_module("common.application").applications() if name[0] != "_" else ():
            new = application.part(part)
            if new is not None and name in _made_in(new):
                _warn(f"{module}.{name}", f"{new.__name__}.{name}")
                return getattr(new, name)
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return find


def _made_in(module: ModuleType) -> set[str]:
    """Names of the messages and topics that a module makes; not what it imports, nor second names (STATUS)."""
    first: dict[int, str] = {}
    for name, value in vars(module).items():
        made = value.__module__ == module.__name__ if isinstance(value, type) else hasattr(value, "key")
        if made:
            first.setdefault(id(value), name)
    return set(first.values())


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old} is {new} now; the old name goes with the next version", DeprecationWarning, stacklevel=3)
