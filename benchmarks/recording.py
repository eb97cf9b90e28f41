"""What it costs to record a whole cell: processor, disk, and whether anything is lost.

`python -m benchmarks.recording` needs about three minutes and a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import subprocess
import tempfile
import time
from pathlib import Path

import psutil

from applications.outlining.topics import CONTOURS
from applications.pick_place.topics import DETECTED_OBJECTS
from common import topics
from common.messages import SupervisorStatus
from recording.reader import Recording
from recording.summary import Summary, summarise
from tests.harness import RunningCell, command_line, environment, folder_for, until

CELLS = {"panda": DETECTED_OBJECTS, "ur5": CONTOURS}
SECONDS = 60.0
SHOWN = 4  # topics that take the most


def all_ready(status: SupervisorStatus) -> bool:
    """Whether every service of the cell is."""
    return all(service.state == "ready" for service in status.services)


def _start(folder: Path, domain: int, seconds: float) -> psutil.Popen:
    arguments = ("record", "-o", "all.mcap", "--duration", str(seconds), "--domain", str(domain))
    return psutil.Popen(command_line(*arguments), cwd=folder, env=environment(), stdout=subprocess.PIPE)


async def measure(folder: Path, name: str, seconds: float) -> list[str]:
    """A recording of everything in a cell that is at work, in lines."""
    with RunningCell(folder, "up", name, "--no-viewer") as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready)
            await until(bus.reader(CELLS[name]), lambda message: message.header.stamp > 0)
        recorder = _start(folder, cell.domain, seconds)
        assert recorder.stdout is not None
        await asyncio.to_thread(recorder.stdout.readline)
        before, began = _processor(recorder), time.monotonic()
        await asyncio.sleep(seconds - 1)
        share = (_processor(recorder) - before) / (time.monotonic() - began)
        memory = recorder.memory_full_info().pss / 1e6
        await asyncio.to_thread(recorder.wait)
        recorder.stdout.close()
        cell.interrupt()
        await cell.ended(20.0)
    with Recording(folder / "all.mcap") as recording:
        summary = summarise(recording)
    return [f"{name}: {100 * share:.1f} % of a core, {memory:.0f} MB", *_lines(summary)]


def _processor(process: psutil.Popen) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _lines(summary: Summary) -> list[str]:
    payload = sum(topic.bytes for topic in summary.topics.values())
    largest = sorted(summary.topics.items(), key=lambda item: -item[1].bytes)[:SHOWN]
    return [
        f"  {summary.messages:,} messages in {summary.seconds:.1f} s, {summary.lost} lost{_where(summary)}",
        f"  {summary.size / 1e6:.1f} MB on disk for {payload / 1e6:.1f} MB of payload",
        *(f"  {name:<30} {topic.hz:7.2f} Hz {topic.bytes / 1e6:9.1f} MB" for name, topic in largest),
    ]


def _where(summary: Summary) -> str:
    lost = {name: (topic.missed, topic.dropped) for name, topic in summary.topics.items()}
    losses = [f"{name} {m} on the way, {d} at the disk" for name, (m, d) in lost.items() if m or d]
    return f" ({'; '.join(losses)})" if losses else ""


async def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="to record of each cell [s]")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as parent:
        for name in CELLS:
            print("\n".join(await measure(folder_for(Path(parent), name), name, seconds)))
    print(f"load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")


if __name__ == "__main__":
    asyncio.run(main())
