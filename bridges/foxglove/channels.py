"""The topics of a cell as channels of Foxglove: each is read only while a client is subscribed."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterable
from typing import Any

from foxglove import Channel, Context, Schema

from bridges.cell_topics import Pumps, drain
from common.errors import ZencellError
from common.messages import Image, Message, PointCloud2
from common.topics import SUPERVISOR_STATUS, Topic, general_key
from common.transport.bus import Bus
from common.transport.ownership import Owner
from common.transport.reader import Reader
from common.transport.session import owns_key
from recording.foxglove import CONVERSION_ERRORS, convert, schema_name, schema_text

LARGE = (Image, PointCloud2)  # converted in a thread


class Channels:
    """Channels of the topics that a service of the cell writes; they appear with their writers and stay."""

    def __init__(self, bus: Bus, topics: Iterable[Topic[Any]], rate: Callable[[], float]) -> None:
        """Declare a reader for each topic, without reading anything.

        Args:
            bus: of the bridge.
            topics: that may become channels.
            rate: returns the maximum rate of a stream, wall time [Hz].
        """
        self.context = Context()
        self._bus, self._rate = bus, rate
        self._readers: dict[str, Reader[Any]] = {
            topic.key: bus.reader(topic, listening=False) for topic in topics}
        self._channels: dict[str, Channel] = {}
        self._keys: dict[int, str] = {}  # by channel id
        self._clients: dict[str, int] = {}  # subscribed, by key
        self._pumps = Pumps(bus, "foxglove")
        self._made: dict[str, Callable[[], bytes]] = {}  # messages of channels without a topic, by key

    def watch(self) -> None:
        """Open a channel for each topic that has a writer, now and later."""
        loop = asyncio.get_running_loop()

        def on_owner(token: str) -> None:  # on a network thread
            loop.call_soon_threadsafe(self._found, general_key(Owner.of(token).key))

        self._bus.raw_watch_tokens(owns_key(self._bus.cell), on_owner)
        self._found(SUPERVISOR_STATUS.key)  # each host's supervisor writes it, so no process owns it

    def add(self, key: str, schema: str, make: Callable[[], bytes]) -> None:
        """Open a channel without a topic: `make` returns its only message, on a thread, for each subscription."""
        self._made[key] = make
        self._open(key, schema)

    def subscribe(self, channel: int) -> None:
        """Read a topic for one more client."""
        if (key := self._keys.get(channel)) is None:
            return
        if key in self._made:
            self._pumps.start(key, self._make(key))
            return
        self._clients[key] = self._clients.get(key, 0) + 1
        reader = self._readers[key]
        if self._clients[key] == 1:
            self._bus.listen(reader, True)
            self._pumps.start(key, self._pump(reader))
        if reader.topic.kind == "state" and (current := reader.latest) is not None:
            self._pumps.start(f"{key} {self._clients[key]}", self._send(reader, current))

    def unsubscribe(self, channel: int) -> None:
        """Read a topic for one client less; without one it is not read any more."""
        if (key := self._keys.get(channel)) is None or key in self._made:
            return
        self._clients[key] = max(0, self._clients.get(key, 0) - 1)
        if not self._clients[key] and self._pumps.stop(key):
            self._bus.listen(self._readers[key], False)

    def close(self) -> None:
        """Stop reading."""
        self._pumps.close()

    def _found(self, key: str) -> None:
        reader = self._readers.get(key)
        if reader is None or key in self._channels or key in self._pumps:
            return
        if issubclass(reader.topic.message, Image):  # its schema depends on the encoding of the pixels
            self._bus.listen(reader, True)
            self._pumps.start(key, self._probe(reader))
        else:
            self._open(key, schema_name(reader.topic.message))

    async def _probe(self, reader: Reader[Any]) -> None:
        """Open the channel of images once the first one is there."""
        message = await reader.next()
        self._bus.listen(reader, False)
        name, _ = await asyncio.to_thread(_encoded, message)
        self._open(reader.topic.key, name)

    def _open(self, key: str, schema: str) -> None:
        described = Schema(name=schema, encoding="jsonschema", data=schema_text(schema))
        channel = Channel(f"{self._bus.cell}/{key.partition('/<')[0]}", message_encoding="json", schema=described,
                          context=self.context)
        self._channels[key] = channel
        self._keys[channel.id()] = key

    async def _make(self, key: str) -> None:
        try:
            data = await asyncio.to_thread(self._made[key])
        except ZencellError as error:
            self._pumps.report(key, str(error))
            return
        self._channels[key].log(data, log_time=self._bus.clock.now_ns())

    async def _pump(self, reader: Reader[Any]) -> None:
        await drain(reader)
        while True:
            await self._send(reader, await reader.next())
            if reader.topic.kind == "stream":
                await asyncio.sleep(1 / self._rate())

    async def _send(self, reader: Reader[Any], message: Message) -> None:
        key = reader.topic.key
        channel = self._channels[key]
        try:
            name, data = await asyncio.to_thread(_encoded, message) if isinstance(message, LARGE) else _encoded(message)
        except CONVERSION_ERRORS as error:
            self._pumps.report(key, str(error))
            return
        if name != channel.schema_name():
            self._pumps.report(key, f"now has the schema {name}, not {channel.schema_name()}; restart the bridge")
            return
        channel.log(data, log_time=stamp_of(message) or self._bus.clock.now_ns())


def _encoded(message: Message) -> tuple[str, bytes]:
    name, value = convert(message)
    return name, json.dumps(value, separators=(",", ":")).encode()


def stamp_of(message: Message) -> int:
    """Return the stamp of a message, or of its first transform [ns]; 0 if it has none."""
    holder: Any = message
    if (transforms := getattr(message, "transforms", None)):
        holder = transforms[0]
    return int(getattr(getattr(holder, "header", None), "stamp", 0))
