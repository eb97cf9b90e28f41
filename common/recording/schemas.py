"""The JSON schema of each message class, as recordings carry it."""

from __future__ import annotations

import json
from functools import cache

from common.application import message_class


@cache
def schema_of(name: str) -> bytes:
    """The JSON schema of a message class as UTF-8; empty for one of somebody else's."""
    found = message_class(name)
    return json.dumps(found.model_json_schema(mode="serialization")).encode() if found else b""
