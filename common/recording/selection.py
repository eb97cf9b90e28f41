"""Which topics of a cell are meant: by key, by regular expression, all but some."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from common.errors import ConfigError


@dataclass(frozen=True)
class Selection:
    """Topics by key (`*` stands for one part, `**` for any number) or regular expression, but those excluded."""

    keys: tuple[str, ...] = ()
    regex: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None

    @classmethod
    def of(cls, keys: Iterable[str] = (), regex: str | None = None, exclude: str | None = None) -> Selection:
        """The selection that a person asked for.

        Raises:
            ConfigError: names the key or expression that can not be used.
        """
        given = tuple(keys)
        for key in given:
            bad = not key or key.startswith("/") or key.endswith("/") or "//" in key or set(key) & set("#?$ ")
            if bad or any("**" in part and part != "**" for part in key.split("/")):
                raise ConfigError("KEY", key, "is not a key such as camera/image_raw, or camera/* or tf*")
        return cls(given, _compiled("--regex", regex), _compiled("--exclude", exclude))

    @property
    def expressions(self) -> tuple[str, ...]:
        """Key expressions, without the cell, that cover what is wanted, and little else."""
        if not self.keys or self.regex is not None:
            return ("**",)
        return tuple(dict.fromkeys(_expression(key) for key in self.keys))

    def wants(self, topic: str) -> bool:
        """Whether a topic (key without the cell) is meant."""
        if self.exclude is not None and self.exclude.search(topic):
            return False
        if self.regex is None and not self.keys:
            return True
        if self.regex is not None and self.regex.search(topic):
            return True
        return any(topic == key or ("*" in key and _pattern(key).fullmatch(topic)) for key in self.keys)


def _compiled(option: str, text: str | None) -> re.Pattern[str] | None:
    if text is None:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise ConfigError(option, text, f"is not a regular expression: {error}") from None


def _expression(key: str) -> str:
    if key.count("**") > 1 or "**/*" in key:  # Zenoh wants these in a form of its own
        return "**"
    return "/".join(part if part in ("*", "**") else part.replace("*", "$*") for part in key.split("/"))


def _pattern(key: str) -> re.Pattern[str]:
    """What a key with wildcards stands for, as Zenoh has it."""
    parts = ["(?:[^/]+/)*" if part == "**" else re.escape(part).replace(r"\*", "[^/]*") + "/" for part in
             key.split("/")]
    return re.compile("".join(parts)[:-1] if not key.endswith("**") else "".join(parts[:-1]) + ".*")
