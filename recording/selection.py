"""Selection of topics by key or regular expression."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from common.errors import ConfigError

PER_SERVICE = ("log", "counters")  # each service has its own; alone these keys select all of them


@dataclass(frozen=True)
class Selection:
    """Topics by key (`*` matches one part, `**` any number) or regular expression, except the excluded ones."""

    keys: tuple[str, ...] = ()
    regex: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None

    @classmethod
    def of(cls, keys: Iterable[str] = (), regex: str | None = None, exclude: str | None = None) -> Selection:
        """Return the selection of a user's keys and expressions.

        Raises:
            ConfigError: names the key or expression that is invalid.
        """
        keys = tuple(keys)
        for key in keys:
            bad = not key or key.startswith("/") or key.endswith("/") or "//" in key or set(key) & set("#?$ ")
            if bad or any("**" in part and part != "**" for part in key.split("/")):
                raise ConfigError("KEY", key, "is not a key such as camera/image_raw, or camera/* or tf*")
        return cls(keys, _compiled("--regex", regex), _compiled("--exclude", exclude))

    @property
    def expressions(self) -> tuple[str, ...]:
        """Key expressions, without the cell, that cover the selection and little else."""
        if not self.keys or self.regex is not None:
            return ("**",)
        return tuple(dict.fromkeys(_expression(f"{key}/**" if key in PER_SERVICE else key) for key in self.keys))

    def wants(self, topic: str) -> bool:
        """Return whether a topic (key without the cell) is selected."""
        if self.exclude is not None and self.exclude.search(topic):
            return False
        if self.regex is None and not self.keys:
            return True
        if self.regex is not None and self.regex.search(topic):
            return True
        return any(covers(key, topic) for key in self.keys)

    def require_in(self, topics: Iterable[str], path: Path, option: str) -> None:
        """Return if each key without wildcards is a topic of a recording.

        Raises:
            ConfigError: names the first that is not, the option that selected it, and the choices.
        """
        every = sorted(topics)
        for key in self.keys:
            if "*" not in key and not any(covers(key, topic) for topic in every):
                raise ConfigError(option, key, f"is not in {path}; choices: {', '.join(every) or 'none'}")


def _compiled(option: str, text: str | None) -> re.Pattern[str] | None:
    if text is None:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise ConfigError(option, text, f"is not a regular expression: {error}") from None


def covers(key: str, topic: str) -> bool:
    """Return whether a key, which may have wildcards, matches a topic."""
    if key in PER_SERVICE and topic.startswith(f"{key}/"):
        return True
    return topic == key or ("*" in key and _pattern(key).fullmatch(topic) is not None)


def _expression(key: str) -> str:
    if key.count("**") > 1 or "**/*" in key:  # Zenoh requires a canonical form of these
        return "**"
    return "/".join(part if part in ("*", "**") else part.replace("*", "$*") for part in key.split("/"))


def _pattern(key: str) -> re.Pattern[str]:
    """Return the regular expression of a key with Zenoh's wildcards."""
    parts = ["(?:[^/]+/)*" if part == "**" else re.escape(part).replace(r"\*", "[^/]*") + "/" for part in
             key.split("/")]
    return re.compile("".join(parts)[:-1] if not key.endswith("**") else "".join(parts[:-1]) + ".*")
