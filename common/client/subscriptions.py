"""What a program hears of a cell: the newest of a topic, cameras."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Coroutine, Generator
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.application import find_topic
from common.client.part import Part
from common.errors import DecodeError, RequestFailed, UnknownName
from common.messages import CameraInfo, Header, Image, Message
from common.perception.image import image_to_array
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.ownership import Owner
from common.transport.reader import Reader

M = TypeVar("M", bound=Message)
Array = NDArray[np.float64]
Carried = Topic[Any] | Request[Any, Any]

PATIENCE = 2.0  # [s] wall until what nothing was heard of counts as not there
PICTURE, DEPTH, INFO = "image_raw", "depth/image_raw", "camera_info"  # last parts of keys of a camera


class NothingReceived(RequestFailed):
    """Nobody says what was asked for."""

    def __init__(self, keys: str, seconds: float = PATIENCE) -> None:
        super().__init__(f"nothing came on {keys} within {seconds:g} s")


def topic_of_owner(owner: Owner) -> Carried | None:
    """What an owner's key carries, known by the owner's own word for it."""
    topic = find_topic(owner.own)
    return replace(topic, key=owner.key) if topic else None


async def find_live_topic(bus: Bus, key: str) -> Carried | None:
    """What a key carries in the cell that is up, where only its owner knows."""
    return next((topic_of_owner(owner) for owner in await bus.owners() if owner.key == key), None)


def local_key(bus: Bus, owner: Owner) -> str | None:
    """The word by which the program knows what somebody says; None where that is not what it means by the word."""
    topic = topic_of_owner(owner)
    meant = topic is not None and bus.full_key(replace(topic, key=owner.own)) == f"{bus.cell}/{owner.key}"
    return owner.own if meant else None


class Subscriptions:
    """The newest messages of a cell: subscribed when first asked for, and from then on."""

    def __init__(self, bus: Bus) -> None:
        """Hear nothing yet."""
        self.bus = bus
        self._readers: dict[str, Reader[Any]] = {}

    def reader(self, topic: Topic[M]) -> Reader[M]:
        """The one reader of a topic; of an event topic take your own, all of which are for you."""
        if topic.key not in self._readers:
            self._readers[topic.key] = self.bus.reader(topic)
        return self._readers[topic.key]

    async def newest(self, topic: Topic[M], seconds: float = PATIENCE) -> M:
        """The value of a state, the newest message of a stream; waits for the first.

        Raises:
            NothingReceived: none came.
        """
        reader = self.reader(topic)
        return reader.latest or await self._next(reader, None, seconds)

    async def now(self, topic: Topic[M]) -> M:
        """The value of a state as its writer has it now, also just after it was changed.

        Raises:
            NothingReceived: nobody has one.
        """
        found: list[M] = []
        self.reader(topic)  # its message can be read from then on
        key = self.bus.full_key(topic)
        for sample in await self.bus.raw_get(key, PATIENCE):
            with contextlib.suppress(DecodeError):
                found.append(decode(topic.message, sample.payload))
        if not found:
            raise NothingReceived(key)
        return max(found, key=lambda each: getattr(each, "header", Header()).stamp)

    async def fresh(self, topic: Topic[M], seconds: float = PATIENCE) -> M:
        """The first message of a stream that comes from now on.

        Raises:
            NothingReceived: none came.
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


class Camera(Part):
    """One camera of a cell. Lengths are in metres, pictures are arrays of (height, width) and channels.

    It is looked up when it is first asked for anything, or when it is awaited itself.
    """

    name: str  # first part of its keys; before it was looked up what was given

    def __init__(self, name: str, ear: Subscriptions, tf: Callable[[str, str], Coroutine[Any, Any, Array]]) -> None:
        """A camera by the first part of its keys, or the only one."""
        self._has(name=name)
        self._ear, self._tf = ear, tf
        self._found = False

    def __await__(self) -> Generator[Any, None, Camera]:
        return self._looked_up().__await__()

    async def _looked_up(self) -> Camera:
        if not self._found:
            self._has(name=await the_camera(self._ear.bus, self.name))
            self._found = True
        return self

    async def _key(self, last: str) -> str:
        return f"{(await self._looked_up()).name}/{last}"

    async def image(self) -> NDArray[np.uint8]:
        """The next picture, (height, width, 3) blue green red, or as its encoding says."""
        return image_to_array(await self.message())

    async def message(self) -> Image:
        """The next picture as it travels, with its stamp and frame."""
        return await self._ear.fresh(replace(topics.CAMERA_IMAGE, key=await self._key(PICTURE)))

    async def depth(self) -> NDArray[np.float32]:
        """The next depth picture (height, width): metres along the optical axis, NaN where there is none.

        Raises:
            NothingReceived: the camera has no depth.
        """
        return image_to_array(await self._ear.fresh(replace(topics.DEPTH_CAMERA_DEPTH, key=await self._key(DEPTH))))

    async def info(self) -> CameraInfo:
        """Size, frame, intrinsics and distortion."""
        return await self._ear.newest(replace(topics.CAMERA_INFO, key=await self._key(INFO)))

    async def intrinsics(self) -> Array:
        """The matrix (3, 3) [px]."""
        return np.array((await self.info()).k).reshape(3, 3)

    async def pose(self, frame: str = "world") -> Array:
        """Where its optical frame is (4, 4): z looks out, x to the right and y down in the picture."""
        return await self._tf(frame, (await self.info()).header.frame_id)


async def cameras(bus: Bus) -> list[str]:
    """Names of the cameras that are there now, sorted: those that the program means in its own words."""
    found = set()
    for owner in await bus.owners():
        topic = topic_of_owner(owner)
        if topic is not None and owner.own in (topics.CAMERA_INFO.key, topics.DEPTH_CAMERA_INFO.key):
            found.add((local_key(bus, owner) or owner.key).removesuffix(f"/{INFO}"))
    return sorted(found)


async def the_camera(bus: Bus, name: str) -> str:
    """The name of a camera that is there; of the only one where none is given.

    Raises:
        UnknownName: there is no such camera, or there are several; with the choices.
    """
    there = await cameras(bus)
    if not name and len(there) == 1:
        return there[0]
    if name not in there:
        raise UnknownName("camera", name, there)
    return name


async def messages(bus: Bus, topic: Topic[M]) -> AsyncGenerator[M, None]:
    """Messages of a topic from now on: of a stream the newest, of an event all."""
    reader = bus.reader(topic)
    try:
        async for message in reader:
            yield message
    finally:
        bus.listen(reader, False)
