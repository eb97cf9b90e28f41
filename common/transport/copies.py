"""Copies of what comes under another key too: readers of ours leave them out, plain Zenoh clients need not."""

from __future__ import annotations

from typing import Any

from common.topics import COUNTERS, LOG, Topic
from common.transport.codec import Attachment, encode_attachment
from common.transport.session import OnSample, RawSample

COPY = encode_attachment(Attachment("copy", 0))


def plain_key(topic: Topic[Any]) -> str:
    """Key, without the cell, that a signed topic had before each service had one of its own."""
    return topic.key.partition("/")[0]


_PLAIN = (plain_key(LOG), plain_key(COUNTERS))


def is_copy(sample: RawSample) -> bool:
    """Whether a message is only a copy."""
    return sample.attachment == COPY and sample.key.partition("/")[2] in _PLAIN


def without_copies(on_sample: OnSample) -> OnSample:
    """The callback, which copies do not reach."""

    def on_original(sample: RawSample) -> None:
        if not is_copy(sample):
            on_sample(sample)

    return on_original
