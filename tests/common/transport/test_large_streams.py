"""A slow reader of images loses no small messages, and does not delay them."""

import asyncio
import threading
import uuid
from collections import Counter
from collections.abc import Iterator

import pytest
import zenoh

from common.transport.endpoint import client_config, endpoint_of
from common.transport.session import RawSample
from common.transport.zenoh_session import ZenohSession, close_within, open_zenoh
from tests.common.transport.conftest import TIMEOUT, until

IMAGE = bytes(4_000_000)
IMAGES = 3  # more than all buffers between writer and reader hold
MANY = 6  # images of each of three cameras
SMALL = {"joint_states": 400, "log": 100}  # messages by key; joint_states is a stream
SMALL_PAYLOAD = bytes(250)


class SlowReader:
    """A reader of all keys of a cell that blocks in its first image until `resume` is set."""

    def __init__(self) -> None:
        self.received: Counter[str] = Counter()
        self.blocked = threading.Event()
        self.resume = threading.Event()

    def on_sample(self, sample: RawSample) -> None:
        name = sample.key.rpartition("/")[2]
        if name == "image":
            self.blocked.set()
            self.resume.wait(4 * TIMEOUT)
        self.received[name] += 1

    @property
    def small(self) -> dict[str, int]:
        return {name: self.received[name] for name in SMALL}


@pytest.fixture
def slow_reader() -> Iterator[SlowReader]:
    reader = SlowReader()
    yield reader
    reader.resume.set()


async def one_link(endpoint: str) -> ZenohSession:
    """Return a session with one link: the default of other clients, and of ours after a reconnection."""
    return ZenohSession(await asyncio.to_thread(zenoh.open, client_config(endpoint, connect_ms=10_000)))


class PlainCamera(ZenohSession):
    """A session without the link for large payloads, as of a camera in another language."""

    def publisher(self, key: str, encoding: str, *, reliable: bool):
        publisher = super().publisher(key, encoding, reliable=reliable)
        publisher._large = publisher._publisher
        return publisher


async def plain_camera(endpoint: str) -> ZenohSession:
    return PlainCamera(await asyncio.to_thread(zenoh.open, client_config(endpoint, connect_ms=10_000)))


async def write_all(camera: ZenohSession, writer: ZenohSession, cell: str, reader: SlowReader) -> None:
    """Publish images until the reader blocks, and then the small messages."""
    images = camera.publisher(f"{cell}/image", "", reliable=False)
    small = {name: writer.publisher(f"{cell}/{name}", "", reliable=name == "log") for name in SMALL}
    await until(lambda: images.matched and all(one.matched for one in small.values()))
    while not reader.blocked.is_set():
        await asyncio.to_thread(images.put, IMAGE, b"")
    for _ in range(IMAGES):
        await asyncio.to_thread(images.put, IMAGE, b"")
    for name, number in SMALL.items():
        for _ in range(number):
            small[name].put(SMALL_PAYLOAD, b"")
            await asyncio.sleep(0)


@pytest.mark.parametrize(("open_reader", "open_camera"), [
    (open_zenoh, open_zenoh), (one_link, open_zenoh), (one_link, one_link), (one_link, plain_camera)])
async def test_small_messages_are_not_lost_behind_images(shared_router, slow_reader, open_reader, open_camera) -> None:
    cell = f"test_{uuid.uuid4().hex[:8]}"
    sessions = [await open_reader(shared_router), await open_camera(shared_router), await one_link(shared_router)]
    reader, camera, writer = sessions
    try:
        reader.subscriber(f"{cell}/**", slow_reader.on_sample)
        await write_all(camera, writer if open_camera is plain_camera else camera, cell, slow_reader)
        if open_reader is one_link:
            slow_reader.resume.set()
        await until(lambda: slow_reader.small == SMALL)
        assert open_reader is one_link or slow_reader.received["image"] == 0, "it still blocks in the first one"
    finally:
        slow_reader.resume.set()
        for session in sessions:
            await close_within(session, 1.0)


@pytest.mark.slow
async def test_images_for_a_slow_reader_delay_no_other_writer(domain: int, processes, slow_reader: SlowReader) -> None:
    processes.start("tests.common.transport.patient_router", "--domain", str(domain))
    endpoint, received = endpoint_of(domain), Counter[str]()
    sessions = [await one_link(endpoint), *[await open_zenoh(endpoint) for _ in range(5)]]
    slow, reader, arm, *cameras = sessions
    try:
        slow.subscriber("cell/**", slow_reader.on_sample)
        images = [camera.publisher("cell/image", "", reliable=False) for camera in cameras]
        states = arm.publisher("cell/joint_states", "", reliable=False)
        await until(lambda: all(one.matched for one in (*images, states)))
        for _ in range(MANY):
            await asyncio.gather(*(asyncio.to_thread(one.put, IMAGE, b"") for one in images))
        await until(slow_reader.blocked.is_set)
        reader.subscriber("cell/joint_states", lambda sample: received.update([sample.key]))
        async with asyncio.timeout(TIMEOUT):
            while not received:  # until the writer learns of the subscription
                states.put(SMALL_PAYLOAD, b"")
                await asyncio.sleep(0.01)
    finally:
        slow_reader.resume.set()
        for session in sessions:
            await close_within(session, 1.0)
