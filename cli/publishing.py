"""Publishing by hand: a message as JSON, checked and stamped."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import options
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.clock import Clock
    from common.messages import Message
    from common.topics import Topic
    from common.transport.bus import Bus

DEFAULT_RATE = "1"  # [Hz]
MATCH_TIMEOUT = 1.0  # [s] for somebody who listens to be found before the first message
LOOK_PERIOD = 0.02  # [s]
LINGER = 0.1  # [s] after the last message, in which the network takes it

Rate = Annotated[str, typer.Option("--rate", "-r", metavar="HZ", help="messages per second")]
Once = Annotated[bool, typer.Option("--once", help="one message, then end")]


def pub(
    key: options.PublishedKey,
    body: Annotated[str, typer.Argument(metavar="JSON", help="its fields; `zencell topic info KEY` shows them")],
    rate: Rate = DEFAULT_RATE,
    once: Once = False,
    count: options.Count = None,
    cell: options.CellName = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Publish a message until Ctrl-C, N times or once; a stamp that is left out is the cell's time of each message.

    A state can be asked for while this runs. A key of your own services takes any JSON; {"base64": "..."} is bytes.
    """
    from cli.inspection import inspect
    from common.transport.credentials import refuse_to_publish

    refuse_to_publish("topic pub")
    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)
    topic = _publishable(key)
    message = checked(topic, key, body)

    async def visit(bus: Bus) -> None:
        from common.client.joining import cell_clock
        from common.topics import of_service

        bus.clock = await cell_clock(bus)
        # A signed one goes under the key of whoever it says that it is of.
        written = of_service(topic, message.service) if topic is not None and topic.signed else topic
        under = written.key if written is not None else key
        _warn_of_writers(await _others(bus, under), under)
        await _publish(_putter(bus, written, key, message), period, most)
        await asyncio.sleep(LINGER)

    inspect(visit, cell=cell, domain=domain, connect=connect)


def _publishable(key: str) -> Topic[Any] | None:
    """The topic of a key; None for one that is not ours.

    Raises:
        ConfigError: it is a request.
    """
    from common.application import find_topic
    from common.topics import Topic

    topic = find_topic(key)
    if topic is None or isinstance(topic, Topic):
        return topic
    raise ConfigError("KEY", key, f"is a request, which is not published: zencell call {key} JSON")


def checked(topic: Topic[Any] | None, key: str, body: str) -> Any:
    """The message that a line of JSON says, or for a key that is not ours the JSON itself.

    Raises:
        ConfigError: it is not JSON, or not the key's message; names the field and what would do.
    """
    from common.config import check
    from common.messages.schema import from_json

    try:
        given = from_json(json.loads(body))
    except ValueError as error:
        raise ConfigError(key, body, f"is not JSON: {error}") from None
    if topic is None:
        return given
    if not isinstance(given, dict):
        raise ConfigError(key, body, f"must be a JSON object, a {topic.message.__name__}")
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


async def _publish(putter: _Putter, period: float, most: int | None) -> None:
    for _ in range(int(MATCH_TIMEOUT / LOOK_PERIOD)):  # who listens is known a moment after declaring
        if putter.matched():
            break
        await asyncio.sleep(LOOK_PERIOD)
    began, sent = time.monotonic(), 0
    while True:
        putter.put()
        sent += 1
        if sent == most:
            return
        await asyncio.sleep(max(0.0, began + sent * period - time.monotonic()))


async def _others(bus: Bus, key: str) -> list[str]:
    """Services of the cell that write the key."""
    return [owner.service for owner in await bus.owners() if owner.key == key]


def _warn_of_writers(services: list[str], key: str) -> None:
    if services:
        echo(f"zencell: {', '.join(services)} writes {key} too: readers get both", err=True)
