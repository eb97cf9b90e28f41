"""Recorded payloads as messages, what is none is counted; and the JSON schema of each message class.

A recording brings the schemas of what is in it, so that it can be read where a class of it is not.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from functools import cache
from typing import cast

import msgpack
from pydantic import BaseModel, ConfigDict, ValidationError

from common.application import message_class
from common.messages import Message
from recording.sample import Sample


class Decoder:
    """Turns samples into messages and counts, by topic, what could not be: somebody else's, or of another version."""

    def __init__(self, own: Iterable[type[Message]] = ()) -> None:
        """Nothing was skipped yet.

        Args:
            own: message classes of a person's own, beside those that come with the project.
        """
        self._own = {model.__name__: model for model in own}
        self.skipped: Counter[str] = Counter()

    def message(self, sample: Sample) -> Message | None:
        """The message that a sample holds, or None for one that cannot be told."""
        known = self._own.get(sample.message) or message_class(sample.message)
        if known is not None or sample.schema:
            try:
                model = known or _told(sample.message)
                values = msgpack.unpackb(sample.payload, raw=False, strict_map_key=True)
                # A field that the class has no more does not make the rest of an old recording worthless.
                return model.model_validate(values, extra="ignore" if known else "allow")
            except (ValidationError, ValueError, TypeError, msgpack.UnpackException, RecursionError):
                pass
        self.skipped[sample.topic] += 1
        return None


@cache
def _told(name: str) -> type[Message]:
    """What stands for a message class that is not here: whatever fields its messages have."""
    config = ConfigDict(extra="allow", ser_json_bytes="base64", ser_json_inf_nan="strings")
    return cast("type[Message]", type(name, (BaseModel,), {"model_config": config, "__module__": __name__}))


def schema_of(name: str) -> bytes:
    """The JSON schema of a message class as UTF-8; empty for one of somebody else's."""
    found = message_class(name)
    return json.dumps(found.model_json_schema(mode="serialization")).encode() if found else b""
