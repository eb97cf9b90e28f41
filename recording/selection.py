"""Which messages of a recording are wanted, and when each is due as it is played."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from common.errors import ConfigError

PER_SERVICE_KEYS = ("log", "counters")  # said of those that each service has for itself, they mean all of them


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
            ConfigError: names the key or expression that cannot be used.
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
        return tuple(dict.fromkeys(_expression(f"{key}/**" if key in PER_SERVICE_KEYS else key) for key in self.keys))

    def wants(self, topic: str) -> bool:
        """Whether a topic (key without the cell) is meant."""
        if self.exclude is not None and self.exclude.search(topic):
            return False
        if self.regex is None and not self.keys:
            return True
        if self.regex is not None and self.regex.search(topic):
            return True
        return any(covers(key, topic) for key in self.keys)

    def require_in(self, topics: Iterable[str], path: Path, option: str) -> None:
        """Return when each key without wildcards is one of the topics of a recording.

        Raises:
            ConfigError: names the first that is not, by the option with which it was given, and the choices.
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
    """Whether a topic is one of those that a key stands for."""
    if key in PER_SERVICE_KEYS and topic.startswith(f"{key}/"):
        return True
    return topic == key or ("*" in key and _pattern(key).fullmatch(topic) is not None)


def _expression(key: str) -> str:
    if key.count("**") > 1 or "**/*" in key:  # Zenoh wants these in a form of its own
        return "**"
    return "/".join(part if part in ("*", "**") else part.replace("*", "$*") for part in key.split("/"))


def _pattern(key: str) -> re.Pattern[str]:
    """What a key with wildcards stands for, as Zenoh has it."""
    parts = ["(?:[^/]+/)*" if part == "**" else re.escape(part).replace(r"\*", "[^/]*") + "/" for part in
             key.split("/")]
    return re.compile("".join(parts)[:-1] if not key.endswith("**") else "".join(parts[:-1]) + ".*")


class Playhead:
    """Where a playback is. Log times and the wall clock are both in ns since the Unix epoch."""

    def __init__(self, position: int, now: int, *, rate: float = 1.0, paused: bool = False) -> None:
        """Begin at a log time.

        Args:
            position: log time to begin at.
            now: wall clock.
            rate: seconds of recording per second.
            paused: wait to be resumed.
        """
        self.rate = rate
        self._position = position  # that was due at _since
        self._since = now
        self._paused = paused

    @property
    def paused(self) -> bool:
        """Whether nothing is due until it is resumed."""
        return self._paused

    def position(self, now: int) -> int:
        """Log time that is due now."""
        return self._position if self._paused else self._position + round((now - self._since) * self.rate)

    def due(self, log_time: int) -> int:
        """Wall clock at which a log time is due, were there no further pause."""
        return self._since + round((log_time - self._position) / self.rate)

    def pause(self, now: int) -> None:
        """Stand still from now on."""
        self._position = self.position(now)
        self._since = now
        self._paused = True

    def resume(self, now: int) -> None:
        """Go on from where it stands."""
        self._since = now
        self._paused = False

    def jump(self, position: int, now: int) -> None:
        """Be at a log time now; whether it is paused does not change."""
        self._position = position
        self._since = now
