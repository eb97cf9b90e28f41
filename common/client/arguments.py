"""Arguments of the client's methods: invalid ones raise an error that names the argument."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from common.errors import ConfigError


def given(fields: Mapping[str, Any], more: Mapping[str, Any], own: Iterable[str] = ("id", "goal")) -> dict[str, Any]:
    """Return the fields of a request, and those that a program adds.

    Raises:
        ConfigError: a field is given twice, or is one of the client's `own`.
    """
    for name in more:
        if name in fields or name in own:
            raise ConfigError(name, more[name], "is set by the client")
    return {**fields, **more}


def listed(name: str, values: Any) -> list[Any]:
    """Return the values of an argument as a list; a text is one value.

    Raises:
        ConfigError: there is no list of values.
    """
    if not isinstance(values, str | Iterable):
        raise ConfigError(name, values, "must be a list")
    return [values] if isinstance(values, str) else list(values)


def require_text(name: str, value: Any) -> None:
    """Check a name, path or key.

    Raises:
        ConfigError: it is not a text.
    """
    if not isinstance(value, str):
        raise ConfigError(name, value, "must be a text")


def require_seconds(name: str, value: Any, longest: float = math.inf) -> None:
    """Check a duration [s].

    Raises:
        ConfigError: it is none, not above 0, or longer than the longest one.
    """
    if not isinstance(value, int | float) or not 0 < value <= longest:
        limit = f" and at most {longest:g} s" if math.isfinite(longest) else " [s]"
        raise ConfigError(name, value, f"must be more than 0{limit}")
