"""Newest messages and cameras of a cell, and the base class of the parts of a `Cell`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Coroutine, Generator
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.application import find_topic
from common.errors import DecodeError, RequestFailed, UnknownName, ZencellError
from common.messages import CameraInfo, Header, Image, Message
from common.perception.image import image_to_array
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.ownership import Owner
from common.transport.reader import Reader

M = TypeVar("M", bound=Message)
Array = NDArray[np.float64]
AnyTopic = Topic[Any] | Request[Any, Any]

TIMEOUT = 2.0  # [s] wall until a topic without messages counts as missing
IMAGE, DEPTH, INFO = "image_raw", "depth/image_raw", "camera_info"  # last parts of the keys of a camera


class ReadOnlyAttribute(ZencellError, AttributeError):
    """Assignment to an attribute of a cell, which would have no effect."""

    def __init__(self, part: str, name: str, there: list[str]) -> None:
        near = get_close_matches(name, there, n=1)
        hint = f": did you mean {near[0]!r}?" if near and near[0] != name else ""
        what = "cannot be set" if name in there else "does not exist"
        super().__init__(f"{part}.{name} {what}{hint or ', and assigning to it changes nothing'}")
        self.attribute = name


class Part:
    """A cell, or a part of one. Public attributes are read-only: a cell is changed by calling methods."""

    def _set(self, **parts: object) -> None:
        """Set public attributes."""
        vars(self).update(parts)

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("_"):
            there = [each for each in {*dir(self), *getattr(type(self), "__annotations__", ())} if each[0] != "_"]
            raise ReadOnlyAttribute(type(self).__name__, name, there)
        super().__setattr__(name, value)


class NothingReceived(RequestFailed):
    """No message arrived on a key in time."""

    def __init__(self, keys: str, seconds: float = TIMEOUT) -> None:
        super().__init__(f"no message on {keys} within {seconds:g} s")


def topic_of_owner(owner: Owner) -> AnyTopic | None:
    """Return the topic or request on an owner's key, found by the name that the owner uses for it."""
    topic = find_topic(owner.own)
    return replace(topic, key=owner.key) if topic else None


async def find_live_topic(bus: Bus, key: str) -> AnyTopic | None:
    """Return the topic or request on a key of the running cell, as its owner declares it."""
    return next((topic_of_owner(owner) for owner in await bus.owners() if owner.key == key), None)


def local_key(bus: Bus, owner: Owner) -> str | None:
    """Return the name that this program uses for an owner's key; None if it means another key by that name."""
    topic = topic_of_owner(owner)
    meant = topic is not None and bus.full_key(replace(topic, key=owner.own)) == f"{bus.cell}/{owner.key}"
    return owner.own if meant else None


class Subscriptions:
    """Readers of a cell's topics, created at first use."""

    def __init__(self, bus: Bus) -> None:
        """Start without any."""
        self.bus = bus
        self._readers: dict[str, Reader[Any]] = {}

    def reader(self, topic: Topic[M]) -> Reader[M]:
        """Return the shared reader of a topic; for an event topic create one of your own, to get every event."""
        if topic.key not in self._readers:
            self._readers[topic.key] = self.bus.reader(topic)
        return self._readers[topic.key]

    async def latest(self, topic: Topic[M], seconds: float = TIMEOUT) -> M:
        """Return the newest message of a topic; wait for the first one.

        Raises:
            NothingReceived: none arrived in time.
        """
        reader = self.reader(topic)
        return reader.latest or await self._next(reader, None, seconds)

    async def query(self, topic: Topic[M]) -> M:
        """Return the value of a state that its writer has now, also just after a change.

        Raises:
            NothingReceived: no writer has one.
        """
        found: list[M] = []
        self.reader(topic)  # its messages can be read from now on
        key = self.bus.full_key(topic)
        for sample in await self.bus.raw_get(key, TIMEOUT):
            with contextlib.suppress(DecodeError):
                found.append(decode(topic.message, sample.payload))
        if not found:
            raise NothingReceived(key)
        return max(found, key=lambda each: getattr(each, "header", Header()).stamp)

    async def next(self, topic: Topic[M], seconds: float = TIMEOUT) -> M:
        """Return the first message of a stream that arrives from now on.

        Raises:
            NothingReceived: none arrived in time.
        """
        reader = self.reader(topic)
        return await self._next(reader, reader.latest, seconds)

    async def _next(self, reader: Reader[M], known: M | None, seconds: float) -> M:
        try:
            async with asyncio.timeout(seconds):
                while True:
                    found = await reader.next()
                    if found is not known:
                        return found
        except TimeoutError:
            raise NothingReceived(f"{self.bus.cell}/{reader.topic.key}", seconds) from None


async def messages(bus: Bus, topic: Topic[M]) -> AsyncGenerator[M, None]:
    """Yield messages of a topic from now on: of a stream the newest, of an event topic all."""
    reader = bus.reader(topic)
    try:
        async for message in reader:
            yield message
    finally:
        bus.listen(reader, False)


class Camera(Part):
    """One camera of a cell. Lengths are in metres; images are arrays (height, width) or (height, width, channels).

    It is looked up when it is first used, or when it is awaited.
    """

    name: str  # first part of its keys; before the lookup the name that was given

    def __init__(
        self, name: str, subscriptions: Subscriptions, tf: Callable[[str, str], Coroutine[Any, Any, Array]]
    ) -> None:
        """Use the camera with that first part of its keys, or the only one if `name` is empty."""
        self._set(name=name)
        self._subscriptions, self._tf = subscriptions, tf
        self._found = False

    def __await__(self) -> Generator[Any, None, Camera]:
        return self._looked_up().__await__()

    async def _looked_up(self) -> Camera:
        if not self._found:
            self._set(name=await find_camera(self._subscriptions.bus, self.name))
            self._found = True
        return self

    async def _key(self, last: str) -> str:
        return f"{(await self._looked_up()).name}/{last}"

    async def image(self) -> NDArray[np.uint8]:
        """Return the next image, (height, width, 3) in blue, green, red, or as its encoding says."""
        return image_to_array(await self.message())

    async def message(self) -> Image:
        """Return the message of the next image, with its stamp and frame."""
        return await self._subscriptions.next(replace(topics.CAMERA_IMAGE, key=await self._key(IMAGE)))

    async def depth(self) -> NDArray[np.float32]:
        """Return the next depth image (height, width): metres along the optical axis, NaN where unknown.

        Raises:
            NothingReceived: the camera has no depth.
        """
        topic = replace(topics.DEPTH_CAMERA_DEPTH, key=await self._key(DEPTH))
        return image_to_array(await self._subscriptions.next(topic))

    async def info(self) -> CameraInfo:
        """Return size, frame, intrinsics and distortion."""
        return await self._subscriptions.latest(replace(topics.CAMERA_INFO, key=await self._key(INFO)))

    async def intrinsics(self) -> Array:
        """Return the camera matrix (3, 3) [px]."""
        return np.array((await self.info()).k).reshape(3, 3)

    async def pose(self, frame: str = "world") -> Array:
        """Return the pose (4, 4) of its optical frame: z points forward, x right and y down in the image."""
        return await self._tf(frame, (await self.info()).header.frame_id)


async def cameras(bus: Bus) -> list[str]:
    """Return the names of the running cameras, sorted, as this program calls them."""
    found = set()
    for owner in await bus.owners():
        topic = topic_of_owner(owner)
        if topic is not None and owner.own in (topics.CAMERA_INFO.key, topics.DEPTH_CAMERA_INFO.key):
            found.add((local_key(bus, owner) or owner.key).removesuffix(f"/{INFO}"))
    return sorted(found)


async def find_camera(bus: Bus, name: str) -> str:
    """Return the name of a running camera; of the only one if `name` is empty.

    Raises:
        UnknownName: there is no such camera, or there are several; with the choices.
    """
    there = await cameras(bus)
    if not name and len(there) == 1:
        return there[0]
    if name not in there:
        raise UnknownName("camera", name, there)
    return name
