"""Keys that a service knows by words of its own, under other names in the cell: how one service serves several times.

`{"camera/*": "left_camera/*", "tf": "left/tf"}`: a key is looked up as it is, then under the longest of the beginnings
that end in `*`, which stands for all that follows; what lies under a key goes where that goes. What everybody says
under the same key is never renamed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from common.errors import ConfigError

PER_SERVICE_KEYS = ("log", "counters", "param")  # first parts of keys that each service has for itself
LONGEST_CELL = 100  # characters of a cell's name
SERVICE_NAME = re.compile(r"[A-Za-z_]\w*")
_KEY = re.compile(r"[^\s/*$?#|]+(/[^\s/*$?#|]+)*")
_BEGINNING = re.compile(r"([^\s/*$?#|]+/?)*\*")


def is_key(text: str) -> bool:
    """Whether a text is one key, without the cell, and stands for no others."""
    return _KEY.fullmatch(text) is not None and text.isprintable() and ".." not in text.split("/")


def is_cell(text: str) -> bool:
    """Whether a cell can have the name: it is the first part of each of its keys, and of names of files."""
    return is_key(text) and "/" not in text and (text[0].isalnum() or text[0] == "_") and len(text) <= LONGEST_CELL


class Remapping:
    """The keys of one service in its cell. Unknown to it are the keys that the service has: see `unused`."""

    def __init__(self, table: Mapping[str, str] | None = None) -> None:
        """Rename nothing, or what a checked table says."""
        self._table = dict(table or {})
        self._used: set[str] = set()
        self._asked: set[str] = set()

    def key(self, own: str) -> str:
        """The key in the cell of a key in the service's own words."""
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
        """Return when everything in the table was needed for a key that the service has.

        Raises:
            ConfigError: something was not, most likely a slip of the hand; with the keys that there are.
        """
        for pattern in self._table:
            if pattern not in self._used:
                raise ConfigError(f"services.{service}.topics", pattern, "is no key that it reads, writes, serves or "
                                  f"asks; choices: {', '.join(sorted(self._asked))}")


def _pattern(table: Mapping[str, str], own: str) -> str | None:
    if own in table:
        return own
    fitting = [entry for entry in table if entry.endswith("*") and own.startswith(entry[:-1])]
    return max(fitting, key=len, default=None)


def validate_table(field: str, given: object) -> dict[str, str]:
    """A table of keys as it stands in a cell file.

    Raises:
        ConfigError: names the entry that cannot be used.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(field, given, "must be a mapping of keys, as in {camera/*: left_camera/*}")
    return dict(_checked(field, given))


def _checked(field: str, given: Mapping[Any, Any]) -> Iterator[tuple[str, str]]:
    for own, key in given.items():
        for text in (own, key):
            if not isinstance(text, str) or not (_BEGINNING if text.endswith("*") else _KEY).fullmatch(text):
                raise ConfigError(field, text, "is no key such as camera/image_raw, nor a beginning such as camera/*")
        if own.endswith("*") != key.endswith("*"):
            raise ConfigError(field, {own: key}, "must have * at both ends or at none")
        if own.partition("/")[0] in PER_SERVICE_KEYS:
            raise ConfigError(field, own, "is a key of all services, which keeps its name")
        yield own, key
