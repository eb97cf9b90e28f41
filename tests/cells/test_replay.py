"""What a detector found live it finds again in the recording, alone, with no camera and no cell."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgpack
import pytest

from common.applications.outlining.topics import CONTOURS
from common.applications.pick_place.topics import DETECTED_OBJECTS
from common.recording.reading import Recording
from common.topics import Topic
from common.transport.connect import connect
from common.transport.endpoint import endpoint_of
from tests.harness import RunningCell, command_line, environment, free_domain, until

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(240)]

LEAST = 5  # pictures whose results are compared
# Of pictures the newest wins: while other work holds a detector up for a second, all that it gets at the pace of the
# recording is the last of them.
SLOWLY = ("--rate", "0.3")
PATIENCE = 60.0  # [s]

CASES = [
    ("panda", "vision_detector", DETECTED_OBJECTS, ["camera/image_raw", "camera/camera_info", "tf_static"], ()),
    ("ur5", "contour_detector", CONTOURS, ["depth_camera/image_raw"], ("--speed", "5")),
]


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


def found_in(path: Path, topic: str) -> dict[int, Any]:
    """What was found in each picture, by the stamp of the picture."""
    with Recording(path) as recording:
        messages = [msgpack.unpackb(sample.payload) for sample in recording.samples(lambda name: name == topic)]
    return {message["header"]["stamp"]: message for message in messages}


async def record_live(folder: Path, cell: str, topic: Topic[Any], wanted: list[str], more: tuple[str, ...]) -> Path:
    """A recording of a cell at work."""
    with RunningCell(folder, "up", cell, "--no-viewer", *more) as live, ExitStack() as at_end:
        async with live.listen() as bus:
            found = bus.reader(topic)
            await until(found, lambda message: message.header.stamp > 0)
            recorder = at_end.enter_context(
                started(folder, "record", *wanted, topic.key, "-o", "live.mcap", "--domain", str(live.domain)))
            assert recorder.stdout is not None and b"recording" in recorder.stdout.readline()
            for _ in range(2 * LEAST):
                await found.next()
        recorder.terminate()
        recorder.wait(PATIENCE)
        live.interrupt()
        await live.ended(PATIENCE)
    return folder / "live.mcap"


async def replay(folder: Path, cell: str, service: str, topic: Topic[Any], wanted: list[str]) -> dict[int, Any]:
    """What the service finds in the recording, by the stamp of the picture."""
    domain = ("--domain", str(number := free_domain()))
    replayed: dict[int, Any] = {}
    with ExitStack() as at_end:
        player = at_end.enter_context(
            started(folder, "play", "live.mcap", "--topics", *wanted, "--wait", service, *SLOWLY, *domain))
        # The player brings the router, and waits for the service, which is started when we listen.
        async with connect(cell=cell, service="listener", endpoint=endpoint_of(number), timeout=PATIENCE) as bus:

            async def listen() -> None:
                async for sample in bus.raw_reader(f"{cell}/{topic.key}"):
                    message = msgpack.unpackb(sample.payload)
                    replayed[message["header"]["stamp"]] = message

            listening = asyncio.create_task(listen())
            await asyncio.sleep(0)
            detector = at_end.enter_context(started(folder, "service", service, "--cell", cell, *domain))
            try:
                assert await asyncio.to_thread(player.wait, PATIENCE) == 0
            finally:
                listening.cancel()
                await asyncio.gather(listening, return_exceptions=True)
                detector.terminate()
                detector.wait(PATIENCE)
    return replayed


@pytest.mark.parametrize(("cell", "service", "topic", "wanted", "more"), CASES, ids=[case[0] for case in CASES])
def test_replayed_pictures_give_what_they_gave_live(
    tmp_path: Path, cell: str, service: str, topic: Topic[Any], wanted: list[str], more: tuple[str, ...]
) -> None:
    recording = asyncio.run(record_live(tmp_path, cell, topic, wanted, more))
    live = found_in(recording, topic.key)
    replayed = asyncio.run(replay(tmp_path, cell, service, topic, wanted))
    both = live.keys() & replayed.keys()
    logs = {path.name: path.read_text() for path in tmp_path.glob("*.log") if path.name != "cell.log"}
    assert len(both) >= LEAST, (len(live), len(replayed), logs)
    assert max(found_in(recording, wanted[0])) in replayed, "the player's router stays until the last result has come"
    for stamp in both:
        first, again = live[stamp], replayed[stamp]
        if topic is CONTOURS:  # which one is chosen depends on all pictures before
            first, again = ({**message, "selected": None, "message": ""} for message in (first, again))
        assert again == first
    some = next(iter(both))
    assert live[some].get("markers") or live[some].get("contours")
