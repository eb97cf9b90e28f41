"""The telemetry of many cells through one router: latency, losses, and what the router needs.

`python -m benchmarks.fleet` replays what the services of a Panda cell really said, as often each second as they say it,
for 1, 2, 5, 10, 25, 50 and 100 cells: joint states at 100 Hz, transforms at 30 Hz, scene, targets, status, counters,
and each state again every second; about 206 messages or 230 kB a second for a cell. Pictures stay in their cell
unless `--pictures` says how many of each cell go through every second. Loopback only, about two minutes.

Every cell is two clients of the router, one that writes and one that reads all of it; two processes hold the writers,
two the readers. Latency is from the put in one process to the callback in another.
"""

from __future__ import annotations

import argparse
import asyncio
import heapq
import multiprocessing
import os
import random
import struct
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh

from benchmarks.transport import router
from common import topics
from common.application import all_topics
from common.messages import Header, Image
from common.topics import Topic
from common.transport.codec import encode
from common.transport.endpoint import client_config, endpoint_of
from common.transport.session import RawSample
from common.transport.zenoh_session import ZenohSession, connect
from tests.harness import RunningCell, free_domain

CELL = "panda"
CELLS = (1, 2, 5, 10, 25, 50, 100)
PROCESSES = 2  # that write, and as many that read
# How often a working cell says what [Hz], repetitions of states included; the rest once a second.
RATES = {
    "joint_states": 100.0, "tf": 30.0, "planning_scene": 20.0, "detected_objects": 10.0, "validated_targets": 10.0,
    topics.COUNTERS.key: 10.0, "scene_balls": 8.0, "motion/status": 8.0, "display_trajectory": 2.0,
    "pick_place_status": 2.0, "gripper/state": 1.0, "supervisor/status": 1.0, "camera/camera_info": 1.0,
    "workspace_markers": 1.0, "tf_static": 1.0, topics.LOG.key: 1.0,
}
SETTLE, MEASURED, REST = 3.0, 6.0, 0.5  # [s]
CONNECT_MS = 60_000
GATHERING = 120.0  # [s] for a cell to say all of it
NOTE = struct.Struct("<qI")  # when it was put [ns, monotonic] and its number


@dataclass
class Spoken:
    """What one topic of a cell says, again and again."""

    key: str
    payload: bytes
    rate: float  # [Hz]
    reliable: bool


async def gather(folder: Path) -> list[Spoken]:
    """The largest of the first messages of each topic of a working cell.

    Raises:
        TimeoutError: not all came.
    """
    found: dict[str, bytes] = {}
    with RunningCell(folder, "run", CELL) as cell:
        async with asyncio.timeout(GATHERING), connect(
            cell=CELL, service="watcher", endpoint=cell.endpoint, timeout=GATHERING
        ) as bus:
            settled: float | None = None
            async for sample in bus.raw_reader(f"{CELL}/**"):
                key = topics.general_key(sample.key.removeprefix(f"{CELL}/"))
                if key in RATES and len(sample.payload) > len(found.get(key, b"")):
                    found[key] = sample.payload
                if settled is None and found.keys() == RATES.keys():
                    settled = time.monotonic() + REST
                if settled is not None and time.monotonic() > settled:
                    break
        cell.interrupt()
        await cell.ended(30.0)
    kinds = {key: topic.kind for key, topic in all_topics().items()}
    # What each service has for itself is said by one here.
    return [Spoken(key.replace(topics.SERVICE, "all"), found[key], rate, kinds[key] != "stream")
            for key, rate in RATES.items()]


def picture(rate: float) -> Spoken:
    """A picture of the camera."""
    topic: Topic[Image] = topics.CAMERA_IMAGE
    data = random.Random(0).randbytes(640 * 480 * 3)
    message = Image(header=Header(), width=640, height=480, encoding="bgr8", data=data)
    return Spoken(topic.key, encode(message), rate, reliable=False)


def _sessions(endpoint: str, names: list[str]) -> dict[str, ZenohSession]:
    # Referenced, because an unreferenced session is closed.
    return {name: ZenohSession(zenoh.open(client_config(endpoint, connect_ms=CONNECT_MS))) for name in names}


def write(endpoint: str, names: list[str], planned: list[Spoken], parent: Connection) -> None:
    """Publish for some cells until the pipe requests the end."""
    sys.setswitchinterval(0.0005)
    due: list[tuple[float, int, float, Any, bytes]] = []
    offsets = random.Random(1)
    sessions = _sessions(endpoint, names)
    for name, session in sessions.items():
        for one in planned:
            publisher = session.publisher(f"{name}/{one.key}", "application/msgpack", reliable=one.reliable)
            due.append((offsets.random() / one.rate, len(due), 1 / one.rate, publisher, one.payload))
    heapq.heapify(due)
    numbers = [0] * len(due)
    parent.send("ready")
    parent.recv()
    start, sent, asked, late = time.monotonic(), 0, False, 0.0
    while not asked:
        now = time.monotonic() - start
        while due[0][0] <= now:
            at, which, period, publisher, payload = due[0]
            late = max(late, now - at)
            numbers[which] += 1
            publisher.put(payload, NOTE.pack(time.monotonic_ns(), numbers[which]))
            heapq.heapreplace(due, (at + period, which, period, publisher, payload))
            sent += 1
            now = time.monotonic() - start
            if not sent % 256 and parent.poll():
                break
        asked = parent.poll(max(0.0, min(0.05, due[0][0] - now)))
    parent.send((sent / (time.monotonic() - start), late))
    os._exit(0)


class Subscriptions:
    """Times and gaps of received messages."""

    def __init__(self) -> None:
        self.on = False
        self.times: list[int] = []  # [ns]
        self.lost = 0
        self.size = 0
        self._newest: dict[str, int] = {}

    def hear(self, sample: RawSample) -> None:
        """Count a message."""
        now = time.monotonic_ns()
        assert sample.attachment is not None
        put, number = NOTE.unpack(sample.attachment)
        before = self._newest.get(sample.key)
        self._newest[sample.key] = number
        if self.on:
            self.times.append(now - put)
            self.size += len(sample.payload)
            if before is not None:
                self.lost += number - before - 1


def read(endpoint: str, names: list[str], parent: Connection) -> None:
    """Subscribe to some cells: count from the start request to the stop request, then send the result."""
    sys.setswitchinterval(0.0005)
    ear = Subscriptions()
    sessions = _sessions(endpoint, names)
    for name, session in sessions.items():
        session.subscriber(f"{name}/**", ear.hear)
    parent.send("ready")
    parent.recv()
    ear.on = True
    parent.recv()
    ear.on = False
    parent.send((np.array(ear.times) * 1e-6, ear.lost, ear.size))
    os._exit(0)


def fleet(cells: int, planned: list[Spoken]) -> str:
    """A line of the table: so many cells through a new router."""
    domain = free_domain()
    endpoint = endpoint_of(domain)
    names = [f"cell_{number}" for number in range(cells)]
    shares = [share for part in range(PROCESSES) if (share := names[part::PROCESSES])]
    context = multiprocessing.get_context("spawn")
    with router(domain) as routing, ExitStack() as stack:

        def start(target: Any, *arguments: Any) -> Connection:
            ours, theirs = context.Pipe()
            process = context.Process(target=target, args=(endpoint, *arguments, theirs), daemon=True)
            process.start()
            stack.callback(process.join)
            stack.callback(process.kill)
            return ours

        readers = [start(read, share) for share in shares]
        writers = [start(write, share, planned) for share in shares]
        for one in (*readers, *writers):
            one.recv()
        for writer in writers:
            writer.send("go")
        time.sleep(SETTLE)
        process = psutil.Process(routing.pid)
        before, began = sum(process.cpu_times()[:2]), time.monotonic()
        for reader in readers:
            reader.send("begin")
        time.sleep(MEASURED)
        for reader in readers:
            reader.send("stop")
        took = time.monotonic() - began
        share, memory = (sum(process.cpu_times()[:2]) - before) / took, process.memory_full_info().pss / 1e6
        received = [reader.recv() for reader in readers]
        for writer in writers:
            writer.send("stop")
        sent_by = [writer.recv() for writer in writers]
    times = np.concatenate([one[0] for one in received])
    lost, size = sum(one[1] for one in received), sum(one[2] for one in received)
    p50, p99 = np.percentile(times, [50, 99])
    wanted, sent = cells * sum(one.rate for one in planned), sum(one[0] for one in sent_by)
    return (f"| {cells} | {sent:.0f} of {wanted:.0f} | {len(times) / took:.0f} | {size / took / 1e6:.1f} | {p50:.2f} | "
            f"{p99:.1f} | {lost} ({lost / (lost + len(times)):.2%}) | {share:.0%} | {memory:.0f} | "
            f"{os.getloadavg()[0]:.0f} |")


def main() -> int:
    """Read the options and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--cells", type=int, nargs="+", default=CELLS)
    parser.add_argument("--pictures", type=float, default=0.0, metavar="HZ", help="of each cell [0]")
    options = parser.parse_args()
    planned = asyncio.run(gather(Path(tempfile.mkdtemp(prefix="zencell-fleet-"))))
    if options.pictures:
        planned.append(picture(options.pictures))
    print("| topic | bytes | Hz |\n|---|---|---|")
    for one in planned:
        print(f"| {one.key} | {len(one.payload):,} | {one.rate:g} |")
    print(f"| together | {sum(len(one.payload) * one.rate for one in planned):,.0f} a second | "
          f"{sum(one.rate for one in planned):g} |\n")
    print("| cells | sent per second | received per second | MB/s | p50 [ms] | p99 [ms] | lost | router, of one core | "
          "router, PSS [MB] | load |\n|---|---|---|---|---|---|---|---|---|---|")
    for cells in options.cells:
        print(fleet(cells, planned), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
