"""What a detector found live it finds again when the recording is played to it, alone, with no camera and no cell."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import RunningCell, command_line, environment, free_domain, until
from tests.simulated.test_replay import found_in

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(240)]

LEAST = 5  # pictures whose results are compared
# Of pictures the newest wins: while other work holds a detector up for a second, all that it gets at the pace of the
# recording is the last of them.
SLOWLY = ("--rate", "0.3")
PATIENCE = 60.0  # [s]

CELL, SERVICE, TOPIC = "panda", "vision_detector", DETECTED_OBJECTS
WANTED = ["camera/image_raw", "camera/camera_info", "tf_static"]


@contextmanager
def started(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """A zencell command under way, which does not outlive the block."""
    with (folder / f"{arguments[0]}.log").open("wb") as log, subprocess.Popen(
        command_line(*arguments), cwd=folder, env=environment(), stdout=subprocess.PIPE, stderr=log
    ) as process:
        try:
            yield process
        finally:
            process.kill()


async def record_live(folder: Path) -> Path:
    """A recording of a cell at work."""
    with RunningCell(folder, "up", CELL) as live, ExitStack() as at_end:
        async with live.listen() as bus:
            found = bus.reader(TOPIC)
            await until(found, lambda message: message.header.stamp > 0)
            recorder = at_end.enter_context(
                started(folder, "record", *WANTED, TOPIC.key, "-o", "live.mcap", "--domain", str(live.domain)))
            assert recorder.stdout is not None and b"recording" in recorder.stdout.readline()
            for _ in range(2 * LEAST):
                await found.next()
        recorder.terminate()
        recorder.wait(PATIENCE)
        live.interrupt()
        await live.ended(PATIENCE)
    return folder / "live.mcap"


async def replay(folder: Path) -> dict[int, Any]:
    """What the service finds in the recording, by the stamp of the picture."""
    domain = ("--domain", str(number := free_domain()))
    replayed: dict[int, Any] = {}
    with ExitStack() as at_end:
        player = at_end.enter_context(
            started(folder, "play", "live.mcap", "--topics", *WANTED, "--wait", SERVICE, *SLOWLY, *domain))
        # The player brings the router, and waits for the service, which is started when we listen.
        async with connect(cell=CELL, service="listener", endpoint=endpoint_of(number), timeout=PATIENCE) as bus:

            async def listen() -> None:
                async for sample in bus.raw_reader(f"{CELL}/{TOPIC.key}"):
                    message = msgpack.unpackb(sample.payload)
                    replayed[message["header"]["stamp"]] = message

            listening = asyncio.create_task(listen())
            await asyncio.sleep(0)
            detector = at_end.enter_context(started(folder, "service", SERVICE, "--cell", CELL, *domain))
            try:
                assert await asyncio.to_thread(player.wait, PATIENCE) == 0
            finally:
                listening.cancel()
                await asyncio.gather(listening, return_exceptions=True)
                detector.terminate()
                detector.wait(PATIENCE)
    return replayed


def test_replayed_images_give_the_live_detections(tmp_path: Path) -> None:
    recording = asyncio.run(record_live(tmp_path))
    live = found_in(recording, TOPIC.key)
    replayed = asyncio.run(replay(tmp_path))
    both = live.keys() & replayed.keys()
    logs = {path.name: path.read_text() for path in tmp_path.glob("*.log") if path.name != "cell.log"}
    assert len(both) >= LEAST, (len(live), len(replayed), logs)
    assert max(found_in(recording, WANTED[0])) in replayed, "the player's router stays until the last result has come"
    assert all(replayed[stamp] == live[stamp] for stamp in both)
    assert live[next(iter(both))]["markers"]
