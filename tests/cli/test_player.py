"""Playing in process: what keys do, what happens to stamps, states before the start."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import msgpack
import pytest

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.messages import Header, Image
from common.transport.local import LocalNetwork
from common.transport.session import RawSample
from recording.player import Player
from recording.reader import Recording
from recording.sample import Sample, stamp_of
from recording.writer import RUN, RecordingWriter
from tests.recording.samples import START, STEP, joints, packed, status, write


def image(number: int) -> Sample:
    log_time = START + number * STEP
    message = Image(header=Header(stamp=log_time), height=1, width=1, encoding="mono8", data=b"x")
    return Sample("panda/camera/image_raw", packed(message), log_time, message="Image", writer="c.1", sequence=number)


class Listener:
    """Hears what is played."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus = net.bus("listener", cell="panda")
        self.came: list[RawSample] = []
        self._more = asyncio.Event()
        self.bus.raw_subscriber("panda/**", self._hear)

    def _hear(self, sample: RawSample) -> None:
        self.came.append(sample)
        self._more.set()

    async def until(self, count: int) -> list[str]:
        """Topics of what came, once so much has."""
        async with asyncio.timeout(20):
            while len(self.came) < count:
                self._more.clear()
                await self._more.wait()
        assert len(self.came) == count
        return [sample.key.partition("/")[2] for sample in self.came]


@asynccontextmanager
async def playing(path: Path, **options: object) -> AsyncIterator[tuple[Player, Listener, asyncio.Task[None]]]:
    net = LocalNetwork()
    listener = Listener(net)
    with Recording(path) as recording:
        player = Player(recording, lambda topic: True, lambda topic: topic, **options)  # type: ignore[arg-type]
        bus = net.bus("player", cell="panda")
        player.declare(bus, recording.topics())
        task = asyncio.create_task(player.run())
        try:
            yield player, listener, task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await bus.close()
            await listener.bus.close()


async def test_steps_of_one_message_and_of_one_picture(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [joints(0), joints(1), joints(2), image(3), joints(4), joints(5)])
    async with playing(path, paused=True) as (player, listener, task):
        player.on_key("right")
        assert await listener.until(1) == ["joint_states"]
        player.on_key("down")
        assert (await listener.until(4))[1:] == ["joint_states", "joint_states", "camera/image_raw"]
        assert player.position == pytest.approx(0.03)
        player.on_key("space")
        await task
        await listener.until(6)


async def test_jump_back_says_the_states_of_there_again(tmp_path: Path) -> None:
    samples = [status(0, "IDLE"), joints(100), status(200, "GRASPING"), joints(900), status(950, "DONE")]
    path = write(tmp_path / "a.mcap", samples, every=1)
    async with playing(path, paused=True) as (player, listener, _task):
        for count in range(1, 5):
            player.on_key("right")
            await listener.until(count)
        player.on_key("left")  # from 9.0 s to 4.0 s: GRASPING was the state then
        assert (await listener.until(5))[4] == "pick_place_status"
        assert msgpack.unpackb(listener.came[4].payload)["state"] == "GRASPING"
        player.on_key("right")
        assert (await listener.until(6))[5] == "joint_states"
        assert player.position == pytest.approx(9.0)


async def test_start_in_the_middle_begins_with_the_states_of_before(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [status(0, "PLACING"), joints(10), joints(20), joints(30)], every=1)
    async with playing(path, offset=0.15) as (_player, listener, task):
        await task
        assert await listener.until(3) == ["pick_place_status", "joint_states", "joint_states"]
        reader = listener.bus.reader(PICK_PLACE_STATUS)  # came too late, and asks
        assert (await asyncio.wait_for(reader.next(), 10)).state == "PLACING"


async def test_loop_is_heard_by_a_reader_each_time(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [joints(0), joints(1)])
    async with playing(path, loop=True) as (player, listener, task):
        reader = listener.bus.reader(topics.JOINT_STATES)
        for _ in range(5):
            await asyncio.wait_for(reader.next(), 10)
        player.on_key("q")
        await asyncio.wait_for(task, 10)


async def test_stamps_stay_unless_they_are_to_be_of_the_present(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [joints(0), joints(1)])
    async with playing(path) as (_player, listener, task):
        await task
        assert [stamp_of(s.payload) for s in listener.came] == [START - 1_000_000, START + STEP - 1_000_000]


async def test_moved_stamps_keep_ages_and_what_was_exposed_together(tmp_path: Path) -> None:
    """In cell time that ran five times as fast: 10 ms on the wall are 50 ms of it."""
    epoch = START - 7 * STEP

    def cell_time(wall: int) -> int:
        return epoch + 5 * (wall - epoch)

    def exposed(sample: Sample, wall: int) -> Sample:
        value = msgpack.unpackb(sample.payload)
        value["header"]["stamp"] = cell_time(wall)
        return replace(sample, payload=msgpack.packb(value))

    writer = RecordingWriter(tmp_path / "a.mcap", {"cell": "panda"})
    writer.describe(RUN, {"speed": 5.0, "epoch": epoch})
    for sample in (exposed(joints(1), START), exposed(image(2), START), exposed(joints(3), START + 3 * STEP)):
        writer.add(sample)
    writer.close()
    async with playing(tmp_path / "a.mcap", stamp_now=True) as (_player, listener, task):
        await task
        first, second, third = (stamp_of(sample.payload) or 0 for sample in listener.came)
    assert first == second
    assert third - first == 3 * STEP  # of wall time
    assert 0 < time.time_ns() - first < 30e9


async def test_player_knows_whether_anybody_listens(tmp_path: Path) -> None:
    net = LocalNetwork()
    with Recording(write(tmp_path / "a.mcap", [image(0)])) as recording:
        player = Player(recording, lambda topic: True, lambda topic: topic)
        player.declare(net.bus("player", cell="panda"), recording.topics())
        assert not player.has_subscribers
        reader = net.bus("listener", cell="panda").reader(topics.CAMERA_IMAGE)
        assert player.has_subscribers
        await player.run()
        assert (await reader.next()).data == b"x"
