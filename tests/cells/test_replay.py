"""Detections of a recording that `zencell play` replays to a detector process equal the live ones."""

import asyncio
import subprocess
from contextlib import contextmanager

import msgpack
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import PATIENCE, command_line, environment, free_domain, running_with
from tests.simulated.test_replay import found_in
from tests.simulated.visited import SimulatedCell

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(240)]

CELL, SERVICE, TOPIC = "panda", "vision_detector", DETECTED_OBJECTS
WANTED = ["camera/image_raw", "camera/camera_info", "tf_static"]
# A detector that other work delays gets only the newest image, so the recording is played slowly.
SLOWLY = ("--rate", "0.3")


@contextmanager
def started(folder, *arguments):
    """Run a zencell command during the block."""
    with (folder / f"{arguments[0]}.log").open("wb") as log, subprocess.Popen(
        command_line(*arguments), cwd=folder, env=environment(), stdout=log, stderr=log) as process:
        try:
            yield process
        finally:
            process.kill()


async def replay(folder):
    """Return the detections of the service in the recording, by the stamp of the image."""
    domain = ("--domain", str(number := free_domain()))
    replayed = {}
    play = ("play", "live.mcap", "--topics", *WANTED, "--wait", SERVICE, *SLOWLY, *domain)
    with started(folder, *play) as player:
        # The player starts the router and waits for the service, which is started once the listener is connected.
        async with connect(cell=CELL, service="listener", endpoint=endpoint_of(number), timeout=PATIENCE) as bus:

            async def listen():
                async for sample in bus.raw_reader(f"{CELL}/{TOPIC.key}"):
                    message = msgpack.unpackb(sample.payload)
                    replayed[message["header"]["stamp"]] = message

            async with running_with(listen()):
                await asyncio.sleep(0)
                with started(folder, "service", SERVICE, "--cell", CELL, *domain):
                    assert await asyncio.to_thread(player.wait, PATIENCE) == 0
    return replayed


def test_replayed_images_give_the_live_detections(tmp_path):
    recording = tmp_path / "live.mcap"
    SimulatedCell(CELL, limit=2.0, record=recording)
    live, replayed = found_in(recording, TOPIC.key), asyncio.run(replay(tmp_path))
    both = live.keys() & replayed.keys()
    logs = {path.name: path.read_text() for path in tmp_path.glob("*.log")}
    assert len(both) >= 5, (len(live), len(replayed), logs)
    assert max(found_in(recording, WANTED[0])) in replayed, "the player's router stays until the last result has come"
    assert all(replayed[stamp] == live[stamp] for stamp in both)
    assert live[next(iter(both))]["markers"]
