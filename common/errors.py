"""Errors that carry their data, so that a message names the object, the value and the choices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any

MAX_SHOWN = 120  # characters of a value


class ZencellError(Exception):
    """An error that users see as one line, without a traceback."""


class ConfigError(ZencellError):
    """An unusable value of the configuration: names the field, the value and what is expected.

    The value `...` means that it is missing, or that several values do not fit together.
    """

    def __init__(self, field: str, value: object, expected: str) -> None:
        shown = " ".join(repr(value).split())  # one line, also for a matrix
        if len(shown) > MAX_SHOWN:
            shown = shown[: MAX_SHOWN - 3] + "..."
        super().__init__(f"{field}: {expected}" if value is ... else f"{field}: {shown} {expected}")
        self.field = field
        self.value = value
        self.expected = expected

    def within(self, section: str) -> ConfigError:
        """Return the same error with the section of the cell that its field is in."""
        return ConfigError(f"{section}.{self.field}", self.value, self.expected)


def expected_text(error: Mapping[str, Any]) -> str:
    """Return what is expected instead of a value, from an item of pydantic's `ValidationError.errors()`."""
    limits = error.get("ctx", {})
    match error["type"]:
        case "too_short":
            return f"must have at least {limits['min_length']} of them"
        case "too_long":
            return f"must have at most {limits['max_length']} of them"
        case "model_type" | "dict_type":
            return "must be a mapping"
        case "list_type":
            return "must be a list"
    text: str = error["msg"].removeprefix("Value error, ").partition(", unable to parse")[0]
    return text.replace("Input should be", "must be").replace("String should", "must").replace("Input ", "")


class UnknownName(ZencellError):
    """A name that is not among the choices."""

    def __init__(self, what: str, name: str, choices: Iterable[str]) -> None:
        listed = sorted(choices)
        near = get_close_matches(str(name), listed, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        super().__init__(f"unknown {what} {name!r}{hint}; choices: {', '.join(listed) or 'none'}")
        self.what = what
        self.name = name
        self.choices = listed


class NoRouter(ZencellError):
    """No router could be reached."""

    def __init__(self, endpoint: str) -> None:
        super().__init__(f"no router at {endpoint}: is the cell up, and is this its domain?")
        self.endpoint = endpoint


class RequestFailed(ZencellError):
    """Base of the four ways in which a request ends without an answer."""


class RemoteError(RequestFailed):
    """The responder refused the request or failed: `code` is for programs, `message` for users."""

    def __init__(self, key: str, code: str, message: str) -> None:
        super().__init__(f"{key}: {message} [{code}]")
        self.key = key
        self.code = code
        self.message = message


class NoResponder(RequestFailed):
    """No service serves the key. Known before sending: the request was certainly not carried out."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key}: no service answers this key")
        self.key = key


class RequestLost(RequestFailed):
    """The responder or the router went away after the request was sent: it may have been carried out."""

    def __init__(self, key: str) -> None:
        super().__init__(f"{key}: the responder went away; the request may have been carried out")
        self.key = key


class RequestTimeout(RequestFailed):
    """No answer in time: the request may still be carried out."""

    def __init__(self, key: str, seconds: float) -> None:
        super().__init__(f"{key}: no answer within {seconds:g} s")
        self.key = key
        self.seconds = seconds


class Refused(ZencellError):
    """Raised by the handler of a request to refuse it; the client gets a `RemoteError`."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class DecodeError(ZencellError):
    """A payload that is no valid message: too large, not msgpack, or of another shape."""
