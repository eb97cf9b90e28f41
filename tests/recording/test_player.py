"""Play in process: keys, stamps, and states from before the start."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.messages import Header, Image
from common.transport.local import LocalNetwork
from common.transport.session import RawSample
from recording.player import Player, Playhead
from recording.reader import Recording
from recording.sample import Sample, stamp_of
from recording.writer import RUN, RecordingWriter
from tests.recording.samples import START, STEP, joints, packed, status, write


def image(number: int) -> Sample:
    log_time = START + number * STEP
    message = Image(header=Header(stamp=log_time), height=1, width=1, encoding="mono8", data=b"x")
    return Sample("panda/camera/image_raw", packed(message), log_time, message="Image", writer="c.1", sequence=number)


class Listener:
    """A subscriber to all played keys."""

    def __init__(self, net: LocalNetwork) -> None:
        self.bus = net.bus("listener", cell="panda")
        self.samples: list[RawSample] = []
        self._more = asyncio.Event()
        self.bus.raw_subscriber("panda/**", self._on_sample)

    def _on_sample(self, sample: RawSample) -> None:
        self.samples.append(sample)
        self._more.set()

    async def until(self, count: int) -> list[str]:
        """Wait for a number of samples, and return their topics."""
        async with asyncio.timeout(20):
            while len(self.samples) < count:
                self._more.clear()
                await self._more.wait()
        assert len(self.samples) == count
        return [sample.key.partition("/")[2] for sample in self.samples]


def player_of(recording: Recording, **options: object) -> Player:
    return Player(recording, lambda topic: True, lambda topic: topic, **options)


@asynccontextmanager
async def playing(path: Path, **options: object) -> AsyncIterator[tuple[Player, Listener, asyncio.Task[None]]]:
    net = LocalNetwork()
    listener, bus = Listener(net), net.bus("player", cell="panda")
    with Recording(path) as recording:
        player = player_of(recording, **options)
        player.declare(bus, recording.topics())
        task = asyncio.create_task(player.run())
        try:
            yield player, listener, task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            await bus.close()
            await listener.bus.close()


async def test_keys_step_by_one_message_and_to_the_next_image(tmp_path):
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


async def test_jump_back_repeats_the_states_of_that_time(tmp_path):
    samples = [status(0, "IDLE"), joints(100), status(200, "GRASPING"), joints(900), status(950, "DONE")]
    path = write(tmp_path / "a.mcap", samples, every=1)
    async with playing(path, paused=True) as (player, listener, _task):
        for count in range(1, 5):
            player.on_key("right")
            await listener.until(count)
        player.on_key("left")  # from 9.0 s to 4.0 s: GRASPING was the state then
        assert (await listener.until(5))[4] == "pick_place_status"
        assert msgpack.unpackb(listener.samples[4].payload)["state"] == "GRASPING"
        player.on_key("right")
        assert (await listener.until(6))[5] == "joint_states"
        assert player.position == pytest.approx(9.0)


async def test_later_start_begins_with_the_earlier_states(tmp_path):
    path = write(tmp_path / "a.mcap", [status(0, "PLACING"), joints(10), joints(20), joints(30)], every=1)
    async with playing(path, offset=0.15) as (_player, listener, task):
        await task
        assert await listener.until(3) == ["pick_place_status", "joint_states", "joint_states"]
        reader = listener.bus.reader(PICK_PLACE_STATUS)  # subscribes too late, and queries
        assert (await asyncio.wait_for(reader.next(), 10)).state == "PLACING"


async def test_stamps_of_the_present_keep_ages_and_simultaneity(tmp_path):
    """In cell time that ran five times as fast: 10 ms on the wall are 50 ms of it."""
    epoch = START - 7 * STEP
    writer = RecordingWriter(tmp_path / "a.mcap", {"cell": "panda"})
    writer.describe(RUN, {"speed": 5.0, "epoch": epoch})
    for sample, wall in ((joints(1), START), (image(2), START), (joints(3), START + 3 * STEP)):
        value = msgpack.unpackb(sample.payload)
        value["header"]["stamp"] = epoch + 5 * (wall - epoch)
        writer.add(replace(sample, payload=msgpack.packb(value)))
    writer.close()
    async with playing(tmp_path / "a.mcap", stamp_now=True) as (_player, listener, task):
        await task
        first, second, third = (stamp_of(sample.payload) or 0 for sample in listener.samples)
    assert first == second and third - first == 3 * STEP  # of wall time
    assert 0 < time.time_ns() - first < 30e9


async def test_player_detects_its_subscribers(tmp_path):
    net = LocalNetwork()
    with Recording(write(tmp_path / "a.mcap", [image(0)])) as recording:
        player = player_of(recording)
        player.declare(net.bus("player", cell="panda"), recording.topics())
        assert not player.has_subscribers
        reader = net.bus("listener", cell="panda").reader(topics.CAMERA_IMAGE)
        assert player.has_subscribers
        await player.run()
        assert (await reader.next()).data == b"x"


SECOND = 1_000_000_000


@given(st.integers(0, 10**15), st.integers(0, 10**15), st.floats(0.01, 1000), st.integers(0, 10**12))
def test_position_and_due_time_are_inverse(start, now, rate, later):
    head = Playhead(start, now, rate=rate)
    assert abs(head.position(head.due(start + later)) - (start + later)) <= rate + 1
    assert abs(head.due(start + later) - (now + later / rate)) <= 2


def test_pause_delays_later_messages_also_after_a_jump():
    head = Playhead(0, 0)
    head.pause(3 * SECOND)
    assert head.paused and head.position(9 * SECOND) == 3 * SECOND
    head.resume(10 * SECOND)
    assert head.due(5 * SECOND) == 12 * SECOND
    head.pause(15 * SECOND)
    head.jump(7 * SECOND, 20 * SECOND)
    assert head.paused and head.position(30 * SECOND) == 7 * SECOND
    head.resume(40 * SECOND)
    assert head.due(8 * SECOND) == 41 * SECOND
