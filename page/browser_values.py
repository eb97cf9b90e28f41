"""Values on their way to and from a browser: one sanitizer for what is sent, one check for what was received.

A value that the encoder of a connection rejects would end the connection of every page for as long as it is shown.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

INVALID = "invalid"  # shown in place of a value that cannot be sent
MAX_SENT_TEXT = 4 * 2**20  # characters of one value, such as the content of a panel
MAX_RECEIVED_TEXT = 4000  # characters, as in messages
MAX_NUMBER = 1e12  # of a received number, as in messages
MAX_ITEMS = 16  # of a received list: a quaternion has 4
_MIN_INT, _MAX_INT = -(2**63), 2**64 - 1  # of msgpack


def sendable(value: Any, bad_number: Any = INVALID) -> Any:
    """Return a plain value that msgpack and JSON can carry; a value that they cannot is replaced.

    Args:
        value: lists, tuples and mappings are copied.
        bad_number: replaces a number that is not finite or exceeds 64 bits.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return value if _MIN_INT <= value <= _MAX_INT else bad_number
    if isinstance(value, float):
        return value if math.isfinite(value) else bad_number
    if isinstance(value, str):
        return value if len(value) <= MAX_SENT_TEXT and _is_encodable(value) else INVALID
    if isinstance(value, list | tuple):
        return [sendable(each, bad_number) for each in value]
    if isinstance(value, Mapping):
        return {str(sendable(name)): sendable(each, bad_number) for name, each in value.items()}
    return INVALID


def to_json(value: Any) -> str:
    """Return a value as JSON that a browser can parse."""
    return json.dumps(sendable(value), allow_nan=False)


def is_acceptable(value: Any) -> bool:
    """Return whether a value from a browser is bounded: finite numbers, short texts, and short lists of these."""
    if isinstance(value, list | tuple):
        return len(value) <= MAX_ITEMS and not any(isinstance(each, list | tuple) for each in value) and all(
            is_acceptable(each) for each in value)
    if isinstance(value, str):
        return len(value) <= MAX_RECEIVED_TEXT and _is_encodable(value)
    return value is None or (isinstance(value, bool | int | float) and abs(value) <= MAX_NUMBER)  # NaN is not


def _is_encodable(text: str) -> bool:
    """Return whether a text has no lone surrogates."""
    if text.isascii():
        return True
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
