"""Publishing by hand: a message as JSON, checked and stamped."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from common.errors import ConfigError

if TYPE_CHECKING:
    from common.clock import Clock
    from common.messages import Message
    from common.topics import AnyTopic, Topic
    from common.transport.bus import Bus

MATCH_TIMEOUT = 1.0  # [s] for somebody who listens to be found before the first message
LOOK_PERIOD = 0.02  # [s]
LINGER = 0.1  # [s] after the last message, in which the network takes it


def checked(topic: AnyTopic | None, key: str, body: str) -> Any:
    """The message that a line of JSON says, or for a key that is not ours the JSON itself.

    Raises:
        ConfigError: it is not JSON, or not the key's message; names the field and what would do.
    """
    from common.config import check
    from common.messages.schema import from_json
    from common.topics import Topic

    try:
        given = from_json(json.loads(body))
    except (ValueError, RecursionError) as error:
        raise ConfigError(key, body, f"is not JSON: {error}") from None
    if topic is None:
        import msgpack

        try:
            msgpack.packb(given)
        except (ValueError, OverflowError) as error:
            raise ConfigError(key, body, f"cannot be sent: {error}") from None
        return given
    if not isinstance(given, dict):
        what = f", a {topic.message.__name__}" if isinstance(topic, Topic) else ""
        raise ConfigError(key, body, f"must be a JSON object{what}")
    if "header" in topic.message.model_fields:
        given.setdefault("header", {})
    return check(topic.message, given, key)


def stamped(message: Message, clock: Clock) -> Message:
    """The message with the cell's time of now wherever a header in it has no stamp of its own."""
    from pydantic import BaseModel

    from common.messages import Header

    now = clock.now_ns()

    def filled(value: Any) -> Any:
        if isinstance(value, Header):
            return value if "stamp" in value.model_fields_set else Header(stamp=now, frame_id=value.frame_id)
        if isinstance(value, BaseModel):
            return value.model_copy(update={name: filled(getattr(value, name)) for name in type(value).model_fields})
        return [filled(item) for item in value] if isinstance(value, list) else value

    made: Message = filled(message)
    return made


class _Putter:
    """Puts the message once more."""

    def __init__(self, put: Callable[[], None], matched: Callable[[], bool]) -> None:
        self.put = put
        self.matched = matched


def _putter(bus: Bus, topic: Topic[Any] | None, key: str, message: Any) -> _Putter:
    if topic is not None:
        writer = bus.writer(topic)
        return _Putter(lambda: writer.put(stamped(message, bus.clock)), lambda: writer.matched)
    import msgpack

    from common.transport.codec import MSGPACK

    raw = bus.raw_writer(f"{bus.cell}/{key}", MSGPACK, "event")

    def put() -> None:
        value = message
        if isinstance(value, dict) and isinstance(header := value.get("header"), dict):
            value = {**value, "header": {"stamp": bus.clock.now_ns(), **header}}
        raw.put(msgpack.packb(value, use_bin_type=True))

    return _Putter(put, lambda: raw.matched)


async def publish(
    bus: Bus, topic: Topic[Any] | None, key: str, message: Any, period: float, most: int | None
) -> None:
    """Publish a message every so often [s], so many times or without end; each is stamped anew.

    Args:
        bus: in the cell.
        topic: of the key; None where it is not ours.
        key: of the topic, without the cell.
        message: what `checked` returned.
        period: [s] wall.
        most: how often.
    """
    putter = _putter(bus, topic, key, message)
    for _ in range(int(MATCH_TIMEOUT / LOOK_PERIOD)):  # who listens is known a moment after declaring
        if putter.matched():
            break
        await asyncio.sleep(LOOK_PERIOD)
    began, sent = time.monotonic(), 0
    while True:
        putter.put()
        sent += 1
        if sent == most:
            break
        await asyncio.sleep(max(0.0, began + sent * period - time.monotonic()))
    await asyncio.sleep(LINGER)


async def writers_of(bus: Bus, keys: Iterable[str]) -> list[tuple[str, str]]:
    """Services of the cell that write one of these keys, each with the key."""
    owners = await bus.owners()
    return [(owner.service, key) for key in keys for owner in owners if owner.key == key]
