"""Bytes that are not what they should be."""

from __future__ import annotations

import msgpack
import numpy as np

from common.chaos.plan import Form
from common.errors import DecodeError
from common.messages import Message
from common.transport.codec import DEFAULT_LIMIT, decode


def damaged(payload: bytes, form: Form, rng: np.random.Generator) -> bytes:
    """A payload in a damaged form; `truncated` and `flipped` start from the one that is given.

    Args:
        payload: a real one, if there is any.
        form: what is wrong with it.
        rng: where the damage is.
    """
    if form == "huge":
        return bytes(DEFAULT_LIMIT + 1)
    if form == "wrong type":
        choices: list[object] = [None, 7, "word", [1, 2, 3], {"header": "never"}, {}, {"poses": [{"position": "here"}]}]
        packed: bytes = msgpack.packb(choices[int(rng.integers(len(choices)))])
        return packed
    if form == "noise" or not payload:
        return rng.bytes(int(rng.integers(1, 2000)))
    if form == "truncated":
        return payload[: int(rng.integers(len(payload)))]
    flipped = bytearray(payload)
    for _ in range(int(rng.integers(1, 9))):
        flipped[int(rng.integers(len(flipped)))] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def nonsense(model: type[Message], form: Form, rng: np.random.Generator) -> bytes:
    """Bytes in a form that needs no real payload, and no message of the model: an empty map is a valid request to stop.

    Args:
        model: what should be there.
        form: huge, wrong type or noise.
        rng: makes them up.
    """
    while True:
        payload = damaged(b"", form, rng)
        try:
            decode(model, payload)
        except DecodeError:
            return payload
