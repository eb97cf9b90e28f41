"""The JSON schema of each message class, as recordings carry it."""

from __future__ import annotations

import json
from functools import cache

from common import messages
from common.messages import Message


@cache
def message_class(name: str) -> type[Message] | None:
    """The message class of a name; None for one of somebody else's."""
    found = getattr(messages, name, None) if name.isidentifier() else None
    return found if isinstance(found, type) and issubclass(found, Message) else None


@cache
def schema_of(name: str) -> bytes:
    """The JSON schema of a message class as UTF-8; empty for one of somebody else's."""
    found = message_class(name)
    return json.dumps(found.model_json_schema()).encode() if found else b""
