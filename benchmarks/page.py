"""What the operator's page costs, how soon it is there and how soon its stop button works, on a cell as it is run.

    python -m benchmarks.page [--cell panda] [--stops 10] [--openings 3]

A browser opens the page first, without a graphics card (benchmarks.first_picture); after that a page is played by a
client that speaks its protocol and draws nothing, so that a browser's own work does not count. The click is timed from
the client's message to the first motion status that says so, and to the first joint state at rest.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import socket
import statistics
import sys
import tempfile
import time
from contextlib import AsyncExitStack
from pathlib import Path

import psutil

from benchmarks.first_picture import chromium, openings
from common import topics
from common.messages import SupervisorStatus
from tests.harness import RunningCell, until
from tests.page.fake_browser import FakeBrowser, opened

SETTLE = 5.0  # [s] after the cell is up, for meshes to be read
MEASURE = 15.0  # [s]
REST = 1e-3  # [rad/s]
FAST = 0.15  # [rad/s] from which the arm is stopped


async def share(process: psutil.Process) -> float:
    """Percent of one core that a process takes from now on, for a while."""
    before, began = process.cpu_times(), time.monotonic()
    await asyncio.sleep(MEASURE)
    after = process.cpu_times()
    return 100 * (after.user + after.system - before.user - before.system) / (time.monotonic() - began)


async def time_stops(cell: RunningCell, page: FakeBrowser, count: int) -> list[tuple[float, float]]:
    """Seconds from a click on STOP to the word of it and to rest, each time while the arm moves for the task."""
    times = []
    async with cell.listen() as bus:
        joints, motion = bus.reader(topics.JOINT_STATES), bus.reader(topics.MOTION_STATUS)
        for _ in range(count):
            await page.press("Start")
            await until(joints, lambda state: max(map(abs, state.velocity)) > FAST)
            began = time.monotonic()
            await page.speak(do="stop", n=1)
            await until(motion, lambda status: status.state == "cancelled")
            confirmed = time.monotonic() - began
            await until(joints, lambda state: max(map(abs, state.velocity)) < REST)
            times.append((confirmed, time.monotonic() - began))
            await asyncio.sleep(0.5)  # the task has received it too
    return times


def all_ready(status: SupervisorStatus) -> bool:
    """Whether every process of the cell is."""
    return all(service.state == "ready" for service in status.services)


async def measure(name: str, stops: int, opened_times: int) -> None:
    """Bring a cell up and write a line for each figure."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder, RunningCell(
            Path(folder), "up", name, "--set", "autostart=false", "--viewer-port", str(port)) as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready)
        await asyncio.sleep(SETTLE)
        ready = re.search(r"is up at \S+ after ([\d.]+) s", cell.text)
        say(f"{name} ready after {ready[1] if ready else '?'} s, with its page")
        process = cell.processes()["viewer"]
        say(f"memory {process.memory_info().rss / 1e6:.0f} MB")
        await say_openings(port, opened_times)
        for count in (0, 1, 10):
            async with AsyncExitStack() as stack:
                began = time.monotonic()
                pages = [await stack.enter_async_context(opened(port)) for _ in range(count)]
                for page in pages:
                    await page.until(lambda page=page: 'data-part="health"' in page.text)  # type: ignore[misc]
                if count == 1:
                    say(f"page filled after {time.monotonic() - began:.2f} s")
                    await pages[0].press("Start")
                say(f"{count} pages open: {await share(process):.1f} % of a core")
                if count == 1:
                    await pages[0].speak(do="stop", n=1)
        async with opened(port) as page:
            times = await time_stops(cell, page, stops)
        for what, values in zip(("stop is confirmed", "arm is at rest"), zip(*times, strict=True), strict=True):
            say(f"{what}: median {1e3 * statistics.median(values):.0f} ms, most {1e3 * max(values):.0f} ms")


async def say_openings(port: int, count: int) -> None:
    """Write how soon a browser shows the page, if there is one."""
    program = chromium()
    if program is None:
        say("no first picture: Chromium is not installed")
        return
    for number, opening in enumerate(await openings(program, f"http://127.0.0.1:{port}", count), 1):
        say(f"opening {number}: panels after {opening.panels:.1f} s, everything drawn after {opening.picture:.1f} s, "
            f"{opening.processor:.1f} s of processor; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", default="panda")
    parser.add_argument("--stops", type=int, default=10)
    parser.add_argument("--openings", type=int, default=3, help="in one browser that has just started")
    options = parser.parse_args()
    asyncio.run(measure(options.cell, options.stops, options.openings))


if __name__ == "__main__":
    main()
