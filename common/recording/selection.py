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
            if not key or key.startswith("/") or key.endswith("/") or "//" in key or set(key) & set("#?$ "):
                raise ConfigError("KEY", key, "is not a key such as camera/image_raw, or camera/* or tf*")
        return cls(given, _compiled("--regex", regex), _compiled("--exclude", exclude))

    @property
    def everything(self) -> bool:
        """Whether all keys of a cell may be wanted."""
        return not self.keys or self.regex is not None

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


def _pattern(key: str) -> re.Pattern[str]:
    """What a key with wildcards stands for, as Zenoh has it."""
    parts = ["(?:[^/]+/)*" if part == "**" else re.escape(part).replace(r"\*", "[^/]*") + "/" for part in
             key.split("/")]
    return re.compile("".join(parts)[:-1] if not key.endswith("**") else "".join(parts[:-1]) + ".*")
