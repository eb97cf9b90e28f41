"""Remap the keys in a service's code to other keys of the cell: so one service runs several times in a cell.

`{"camera/*": "left_camera/*", "tf": "left/tf"}`: a key is looked up as it is, then as the longest prefix that ends in
`*`, which matches the rest of the key. Keys below a remapped key follow it. Keys that each service has for itself
are never remapped.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from common.errors import ConfigError

PER_SERVICE_KEYS = ("log", "counters", "param")  # first parts of keys that each service has for itself
# Keys that each arm of a cell with several has for itself, below its name; an application adds some: common/arms.py.
ARM_KEYS = ("joint_states", "tf", "tf_static", "motion/*", "gripper/*", "robot/*", "display_trajectory",
            "planning_scene", "scene/*", "task/*")
POSE_KEYS = ("tf", "tf_static")
MAX_CELL_NAME = 100  # characters
SERVICE_NAME = re.compile(r"[A-Za-z_]\w*")
_KEY = re.compile(r"[^\s/*$?#|]+(/[^\s/*$?#|]+)*")
_PREFIX = re.compile(r"([^\s/*$?#|]+/?)*\*")


def is_key(text: str) -> bool:
    """Return whether a text is one key without the cell and without wildcards."""
    return _KEY.fullmatch(text) is not None and text.isprintable() and ".." not in text.split("/")


def is_cell(text: str) -> bool:
    """Return whether a text is a valid cell name: it is the first part of all its keys, and of file names."""
    return is_key(text) and "/" not in text and (text[0].isalnum() or text[0] == "_") and len(text) <= MAX_CELL_NAME


class Remapping:
    """The remapped keys of one service; remembers which it has used, for `require_used`."""

    def __init__(self, table: Mapping[str, str] | None = None) -> None:
        """Remap nothing, or by a validated table."""
        self._table = dict(table or {})
        self._used: set[str] = set()
        self._asked: set[str] = set()

    @property
    def table(self) -> dict[str, str]:
        """Keys in the cell by keys in the code."""
        return dict(self._table)

    def key(self, own: str) -> str:
        """Return the key in the cell of a key in the service's code."""
        if own.partition("/")[0] in PER_SERVICE_KEYS:
            return own
        self._asked.add(own)
        found = _pattern(self._table, own)
        if found is None:
            above, _, name = own.rpartition("/")
            return f"{self.key(above)}/{name}" if above in self._table else own
        self._used.add(found)
        return self._table[found].replace("*", own[len(found) - 1:]) if found.endswith("*") else self._table[found]

    def require_used(self, service: str) -> None:
        """Return if every entry of the table matches a key of the service, or only puts it below the name of an arm.

        Raises:
            ConfigError: an entry matches none, most likely a typing error; lists the keys.
        """
        of_arm = all(key in self._table for key in POSE_KEYS)
        for pattern in self._table:
            if pattern not in self._used and not (of_arm and self._table[pattern].endswith(f"/{pattern}")):
                raise ConfigError(f"services.{service}.topics", pattern, "is no key that it reads, writes, serves or "
                                  f"calls; choices: {', '.join(sorted(self._asked))}")


def _pattern(table: Mapping[str, str], own: str) -> str | None:
    if own in table:
        return own
    fitting = [entry for entry in table if entry.endswith("*") and own.startswith(entry[:-1])]
    return max(fitting, key=len, default=None)


def validate_table(field: str, given: object) -> dict[str, str]:
    """Return a table of keys from a cell file.

    Raises:
        ConfigError: names the invalid entry.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(field, given, "must be a mapping of keys, as in {camera/*: left_camera/*}")
    return dict(_entries(field, given))


def _entries(field: str, given: Mapping[Any, Any]) -> Iterator[tuple[str, str]]:
    for own, key in given.items():
        for text in (own, key):
            if not isinstance(text, str) or not (_PREFIX if text.endswith("*") else _KEY).fullmatch(text):
                raise ConfigError(field, text, "is no key such as camera/image_raw, nor a prefix such as camera/*")
        if own.endswith("*") != key.endswith("*"):
            raise ConfigError(field, {own: key}, "must have * at both ends or at none")
        if own.partition("/")[0] in PER_SERVICE_KEYS:
            raise ConfigError(field, own, "is a key of all services, which keeps its name")
        yield own, key
