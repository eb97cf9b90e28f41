"""Who falls behind in pictures loses no small message with them, and waits for none behind them."""

from __future__ import annotations

import asyncio
import threading
import uuid
from collections import Counter
from collections.abc import Iterator

import pytest
import zenoh

from common.transport.endpoint import LINKS, client_config, endpoint_of
from common.transport.session import RawSample
from common.transport.zenoh_session import ZenohSession, close_within, open_zenoh

PATIENCE = 20.0  # only ever waited for by a test that fails
PICTURE = bytes(4_000_000)
PICTURES = 3  # more than all buffers on the way hold
MANY = 6  # the same of each of three cameras
SMALL = {"joint_states": 400, "log": 100}  # messages of each key; the first are those of a stream
BYTES = bytes(250)


class Behind:
    """Reads everything of a cell, and once a picture came takes nothing more over that link until it may."""

    def __init__(self) -> None:
        self.came: Counter[str] = Counter()
        self.busy = threading.Event()
        self.may = threading.Event()

    def on_sample(self, sample: RawSample) -> None:
        name = sample.key.rpartition("/")[2]
        if name == "image":
            self.busy.set()
            self.may.wait(4 * PATIENCE)
        self.came[name] += 1

    @property
    def small(self) -> dict[str, int]:
        return {name: self.came[name] for name in SMALL}


@pytest.fixture
def behind() -> Iterator[Behind]:
    reader = Behind()
    yield reader
    reader.may.set()


async def one_link(endpoint: str) -> ZenohSession:
    """A client with whatever comes by default, as other tools are; so is ours when the router was away."""
    return ZenohSession(await asyncio.to_thread(zenoh.open, client_config(endpoint, connect_ms=10_000)))


class Foreign(ZenohSession):
    """One that knows nothing of what is large, as a camera's in another language may be."""

    def publisher(self, key: str, encoding: str, *, reliable: bool):
        made = super().publisher(key, encoding, reliable=reliable)
        made._large = made._publisher
        return made


async def foreign(endpoint: str) -> ZenohSession:
    return Foreign(await asyncio.to_thread(zenoh.open, client_config(endpoint, connect_ms=10_000)))


async def write_all(camera: ZenohSession, writer: ZenohSession, cell: str, reader: Behind, until) -> None:
    """Put pictures until the reader takes no more of them, and then what is small."""
    picture = camera.publisher(f"{cell}/image", "", reliable=False)
    small = {name: writer.publisher(f"{cell}/{name}", "", reliable=name == "log") for name in SMALL}
    await until(lambda: picture.matched and all(one.matched for one in small.values()))
    while not reader.busy.is_set():
        await asyncio.to_thread(picture.put, PICTURE, b"")
    for _ in range(PICTURES):
        await asyncio.to_thread(picture.put, PICTURE, b"")
    for name, number in SMALL.items():
        for _ in range(number):
            small[name].put(BYTES, b"")
            await asyncio.sleep(0)


async def test_what_is_small_does_not_wait_behind_pictures(shared_router: str, behind: Behind, until) -> None:
    cell = f"test_{uuid.uuid4().hex[:8]}"
    reader, writer = await open_zenoh(shared_router), await open_zenoh(shared_router)
    try:
        reader.subscriber(f"{cell}/**", behind.on_sample)
        await write_all(writer, writer, cell, behind, until)
        await until(lambda: behind.small == SMALL)
        assert behind.came["image"] == 0  # it still holds the first
    finally:
        behind.may.set()
        for session in (reader, writer):
            await close_within(session, 1.0)


@pytest.mark.parametrize("open_camera", [open_zenoh, one_link, foreign])
async def test_over_one_link_no_small_message_is_lost_with_pictures(
    shared_router: str, behind: Behind, until, open_camera
) -> None:
    cell = f"test_{uuid.uuid4().hex[:8]}"
    sessions = [await one_link(shared_router), await open_camera(shared_router), await one_link(shared_router)]
    reader, camera, writer = sessions
    try:
        reader.subscriber(f"{cell}/**", behind.on_sample)
        await write_all(camera, writer if open_camera is foreign else camera, cell, behind, until)
        behind.may.set()
        await until(lambda: behind.small == SMALL)
    finally:
        behind.may.set()
        for session in sessions:
            await close_within(session, 1.0)


@pytest.mark.slow
async def test_while_pictures_wait_for_a_reader_all_else_goes_on(domain: int, processes, behind: Behind, until) -> None:
    processes.start("tests.common.transport.patient_router", "--domain", str(domain))
    endpoint, came = endpoint_of(domain), Counter[str]()
    sessions = [await one_link(endpoint), *[await open_zenoh(endpoint) for _ in range(5)]]
    stuck, reader, arm, *cameras = sessions
    try:
        stuck.subscriber("cell/**", behind.on_sample)
        pictures = [camera.publisher("cell/image", "", reliable=False) for camera in cameras]
        states = arm.publisher("cell/joint_states", "", reliable=False)
        await until(lambda: all(one.matched for one in (*pictures, states)))
        for _ in range(MANY):
            await asyncio.gather(*(asyncio.to_thread(one.put, PICTURE, b"") for one in pictures))
        await until(behind.busy.is_set)
        reader.subscriber("cell/joint_states", lambda sample: came.update([sample.key]))
        async with asyncio.timeout(PATIENCE):
            while not came:  # its subscription is heard of somewhen
                states.put(BYTES, b"")
                await asyncio.sleep(0.01)
    finally:
        behind.may.set()
        for session in sessions:
            await close_within(session, 1.0)


async def test_pictures_have_a_link_of_their_own(shared_router: str) -> None:
    session = await open_zenoh(shared_router)
    try:
        links = session._session.info.links()  # type: ignore[attr-defined]
        assert sorted(link.priorities for link in links) == [tuple(map(int, one.split("-"))) for one in LINKS]
    finally:
        await close_within(session, 1.0)
