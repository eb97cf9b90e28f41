"""What the transport costs: a picture and a small message one way, a request there and back, a death noticed.

`python -m benchmarks.transport` takes about a minute. Each time is from the call in one process to the message in the
loop of another, through the router of a domain, encoded and checked as in a cell.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess

import numpy as np

from common import messages as m
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.endpoint import endpoint_of
from common.transport.zenoh_session import connect
from tests.harness import ROOT, environment, free_domain

CELL = "transport"
WRITER = "writer"
PICTURE = Topic("picture", m.Image, "stream", "640 x 480, bgr8")
SMALL = Topic("small", m.SceneUpdate, "event", "about 100 bytes")
ECHO = Request("echo", m.HoldRequest, m.HoldRequest, "answers with what was asked")
WIDTH, HEIGHT = 640, 480
PICTURE_RATE, SMALL_RATE = 30.0, 100.0  # [Hz]
PATIENCE = 90.0  # [s] for a process to be there
WARM = 20  # of the first messages do not count


@contextmanager
def router(domain: int) -> Iterator[subprocess.Popen[bytes]]:
    """The router of a domain, during the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "services.router", "--domain", str(domain)], cwd=ROOT, env=environment(),
        stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


async def _write(endpoint: str) -> None:
    async with connect(cell=CELL, service=WRITER, endpoint=endpoint, timeout=PATIENCE) as bus:

        async def echo(request: m.HoldRequest) -> m.HoldRequest:
            return request

        bus.serve(ECHO, echo)
        await bus.ready()
        data = os.urandom(WIDTH * HEIGHT * 3)
        pictures, smalls = bus.writer(PICTURE), bus.writer(SMALL)

        async def put_pictures() -> None:
            while True:
                header = m.Header(stamp=time.monotonic_ns())
                pictures.put(m.Image(header=header, width=WIDTH, height=HEIGHT, encoding="bgr8", data=data))
                await asyncio.sleep(1 / PICTURE_RATE)

        async def put_smalls() -> None:
            while True:
                smalls.put(m.SceneUpdate(header=m.Header(stamp=time.monotonic_ns()), data="remove:ball_3 " + 24 * "."))
                await asyncio.sleep(1 / SMALL_RATE)

        await asyncio.gather(put_pictures(), put_smalls())


def write(endpoint: str) -> None:
    """Be the other process, until killed."""
    asyncio.run(_write(endpoint))


def start_writer(endpoint: str) -> BaseProcess:
    """The other process."""
    process = multiprocessing.get_context("spawn").Process(target=write, args=(endpoint,), daemon=True)
    process.start()
    return process


async def one_way(bus: Bus, topic: Topic[m.Image] | Topic[m.SceneUpdate], seconds: float) -> list[float]:
    """Times from put to the loop [ms] of the messages that come in so many seconds; nothing else is listened to."""
    reader = bus.reader(topic)
    times: list[float] = []
    try:
        async with asyncio.timeout(seconds):
            async for message in reader:
                times.append((time.monotonic_ns() - message.header.stamp) * 1e-6)
    except TimeoutError:
        bus.listen(reader, False)
    return times[WARM:]


async def round_trips(bus: Bus, seconds: float) -> list[float]:
    """Times of requests, one after the other [ms]."""
    client = bus.client(ECHO)
    await client.wait_available(PATIENCE)
    times: list[float] = []
    end = time.monotonic() + seconds
    while (began := time.monotonic()) < end:
        await client.call(m.HoldRequest(hold=True), 5.0)
        times.append((time.monotonic() - began) * 1e3)
        await asyncio.sleep(0.005)
    return times[WARM:]


async def deaths(bus: Bus, endpoint: str, how: signal.Signals, times: int) -> list[float]:
    """Times from a signal to the loss of the liveliness token, as another process sees it [ms]."""
    found = []
    for _ in range(times):
        process = start_writer(endpoint)
        await bus.alive.wait(WRITER, PATIENCE)
        await asyncio.sleep(0.3)
        began = time.monotonic()
        assert process.pid is not None
        os.kill(process.pid, how)
        await bus.alive.wait(WRITER, PATIENCE, there=False)
        found.append((time.monotonic() - began) * 1e3)
        process.kill()
        process.join()
    return found


async def measure(seconds: float, times: int) -> list[str]:
    """The table as lines."""
    sys.setswitchinterval(0.0005)  # as every service does
    lines = ["| what | number | p50 [ms] | p99 [ms] | longest [ms] |", "|---|---|---|---|---|"]

    def add(what: str, found: list[float]) -> None:
        p50, p99 = np.percentile(found, [50, 99])
        lines.append(f"| {what} | {len(found)} | {p50:.2f} | {p99:.2f} | {max(found):.2f} |")

    domain = free_domain()
    endpoint = endpoint_of(domain)
    with router(domain):
        async with connect(cell=CELL, service="reader", endpoint=endpoint, timeout=PATIENCE) as bus:
            writer = start_writer(endpoint)
            await bus.alive.wait(WRITER, PATIENCE)
            add(f"picture, {WIDTH * HEIGHT * 3:,} bytes, one way", await one_way(bus, PICTURE, seconds))
            add("100 bytes, one way", await one_way(bus, SMALL, seconds))
            add("request and answer", await round_trips(bus, seconds))
            writer.kill()
            await bus.alive.wait(WRITER, PATIENCE, there=False)
            writer.join()
            add("SIGKILL until it is seen to be gone", await deaths(bus, endpoint, signal.SIGKILL, times))
            add("SIGSTOP until it is seen to be gone", await deaths(bus, endpoint, signal.SIGSTOP, max(1, times // 2)))
    return lines


def main() -> int:
    """Read the options and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.transport", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="for each kind of message")
    parser.add_argument("--deaths", type=int, default=6)
    options = parser.parse_args()
    before = os.getloadavg()[0]
    lines = asyncio.run(measure(options.seconds, options.deaths))
    print(f"{os.cpu_count()} cores, load {before:.1f} before, {os.getloadavg()[0]:.1f} after")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
