"""Detections of replayed images equal the live ones, without a camera or a cell."""

import asyncio
import importlib
from pathlib import Path
from typing import Any, Literal

import msgpack
import pytest

from applications.outlining.topics import CONTOURS
from applications.pick_place.topics import DETECTED_OBJECTS
from common.config import load_cell, service_config
from common.process.in_process import running_service
from common.topics import Topic
from common.transport.local import LocalNetwork
from common.transport.writer import RawWriter
from recording.reader import Recording
from recording.sample import encoding_of
from tests.simulated.visited import SimulatedCell

LEAST = 5  # images whose results are compared
CASES = [
    ("panda", "vision_detector", DETECTED_OBJECTS, ["camera/camera_info", "tf_static"], "camera/image_raw"),
    ("ur5", "contour_detector", CONTOURS, [], "depth_camera/image_raw"),
]


def found_in(path: Path, topic: str) -> dict[int, Any]:
    """Return the detections of each image by its stamp."""
    with Recording(path) as recording:
        messages = [msgpack.unpackb(sample.payload) for sample in recording.samples(lambda name: name == topic)]
    return {message["header"]["stamp"]: message for message in messages}


async def replay(path: Path, name: str, service: str, topic: Topic[Any], states: list[str], pictures: str) -> list[Any]:
    """Return the detections of the service in each image of the recording."""
    cell, net, found = load_cell(name), LocalNetwork(), []
    module = importlib.import_module(f"services.{service}")
    bus, results = net.bus("player", cell=name), asyncio.Queue[bytes]()
    bus.raw_subscriber(f"{name}/{topic.key}", lambda sample: results.put_nowait(sample.payload))
    writers: dict[str, RawWriter] = {}
    async with running_service(net, module.run, service_config(cell, service, module.Config), name=service, cell=name):
        with Recording(path) as recording:
            for sample in recording.samples(lambda key: key in (*states, pictures)):
                if sample.topic not in writers:
                    kind: Literal["state", "stream"] = "state" if sample.topic in states else "stream"
                    writers[sample.topic] = bus.raw_writer(f"{name}/{sample.topic}", encoding_of(sample.message), kind)
                writers[sample.topic].put(sample.payload, sample.trace)
                if sample.topic == pictures:
                    async with asyncio.timeout(60):
                        found.append(msgpack.unpackb(await results.get()))
    return found


@pytest.mark.parametrize(("cell", "service", "topic", "states", "pictures"), CASES, ids=[case[0] for case in CASES])
@pytest.mark.slow
def test_replayed_images_give_the_live_detections(
    tmp_path: Path, cell: str, service: str, topic: Topic[Any], states: list[str], pictures: str
) -> None:
    recording = tmp_path / "live.mcap"
    SimulatedCell(cell, limit=8.0, record=recording)
    live = found_in(recording, topic.key)
    replayed = asyncio.run(replay(recording, cell, service, topic, states, pictures))
    again = {message["header"]["stamp"]: message for message in replayed}
    both = live.keys() & again.keys()
    assert len(both) >= LEAST and len(live) - len(both) <= 1
    for stamp in both:
        one, other = live[stamp], again[stamp]
        if topic is CONTOURS:  # which one is chosen depends on all pictures before
            one, other = ({**message, "selected": None, "message": ""} for message in (one, other))
        assert other == one
    some = next(iter(both))
    assert live[some].get("markers") or live[some].get("contours")
