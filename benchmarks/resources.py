"""What the Panda cell costs: time until it is ready and moves, memory, processor, delay of the picture, disk.

`python -m benchmarks.resources` needs about two minutes and a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import tempfile
from collections import defaultdict
from importlib.metadata import distribution
from pathlib import Path
from statistics import median

import psutil
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from common import topics
from tests.harness import RunningCell, folder_for, until

CELL = "panda"
STARTS = 3
SETTLED = 5.0  # [s] after the first motion the measuring begins
SAMPLES, PERIOD = 10, 2.0  # looks at memory and processor, and [s] between them
SHOWN = 12  # largest parts of the environment
TIMEOUT = 180.0  # [s] for one run


async def start_once(folder: Path) -> tuple[float, float]:
    """Wall time [s] from the start of the command to all services ready, and to the first motion."""
    with RunningCell(folder, "run", CELL) as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), lambda status: status.progress > 0)
        cell.interrupt()
        await cell.ended(10.0)
        seconds = cell.summary["seconds"]
        return float(seconds["ready"]), float(seconds["first_motion"])


async def whole_run(folder: Path) -> list[str]:
    """Memory, processor and delay of a run with defaults at speed 1, as lines."""
    with RunningCell(folder, "run", CELL) as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), lambda status: status.progress > 0)
        await asyncio.sleep(SETTLED)
        processes = {**cell.processes(), "supervisor": psutil.Process(cell.process.pid)}
        before = {name: _cpu(process) for name, process in processes.items()}
        memory: dict[str, list[float]] = defaultdict(list)
        for _ in range(SAMPLES):
            await asyncio.sleep(PERIOD)
            for name, process in processes.items():
                memory[name].append(process.memory_full_info().pss / 1e6)
        after = {name: _cpu(process) for name, process in processes.items()}
        code = await cell.ended(TIMEOUT)
        summary = cell.summary
    share = {name: (after[name] - before[name]) / (SAMPLES * PERIOD) for name in processes}
    lines = ["", "| process | PSS [MB] | of one core |", "|---|---|---|"]
    lines += [f"| {name} | {max(memory[name]):.0f} | {share[name]:.1%} |" for name in processes]
    together = max(map(sum, zip(*memory.values(), strict=True)))
    lines.append(f"| together | {together:.0f} | {sum(share.values()):.1%} |")
    delay = summary["frame_to_target_ms"]
    lines += ["", f"run at speed 1: exit code {code}, {summary['state']}, {summary['truth']['in_box']} balls in the "
              f"box, task {summary['seconds']['task']:.1f} s",
              f"frame to validated target: p50 {delay['p50']:.1f} ms, p99 {delay['p99']:.1f} ms"]
    return lines


def _cpu(process: psutil.Process) -> float:
    """Processor time [s] that a process has used."""
    times = process.cpu_times()
    return times.user + times.system


def environment() -> list[str]:
    """Size of everything that zencell needs besides Python, and its largest parts, as lines."""
    sizes = {name: _size(name) for name in sorted(needed("zencell"))}
    lines = ["", f"environment: {sum(sizes.values()) / 1e9:.2f} GB in {len(sizes)} packages; the largest [MB]:"]
    for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:SHOWN]:
        lines.append(f"  {size / 1e6:6.0f}  {name}")
    return lines


def needed(name: str) -> set[str]:
    """Return the distributions that one requires, recursively, without unrequested extras."""
    found: set[str] = set()
    open_ends: list[tuple[str, frozenset[str]]] = [(name, frozenset())]
    seen = set()
    while open_ends:
        current = open_ends.pop()
        if current in seen:
            continue
        seen.add(current)
        for text in distribution(current[0]).requires or []:
            requirement = Requirement(text)
            asked = [{"extra": extra} for extra in ("", *current[1])]
            if requirement.marker is None or any(requirement.marker.evaluate(extra) for extra in asked):
                found.add(canonicalize_name(requirement.name))
                open_ends.append((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    return found


def _size(name: str) -> int:
    """What the files of a distribution take on the disk [bytes], compiled ones included."""
    paths = (Path(str(file.locate())) for file in distribution(name).files or [])
    return sum(path.lstat().st_blocks * 512 for path in paths if path.exists())


async def measure(folder: Path) -> None:
    """Measure everything and print it."""
    starts = [await start_once(folder_for(folder, f"start {number}")) for number in range(STARTS + 1)]
    ready, moving = zip(*starts[1:], strict=True)  # the first fills the file cache
    print(f"ready {median(ready):.2f} s, first motion {median(moving):.2f} s (medians of {STARTS}, warm file cache; "
          f"ready from {min(ready):.2f} to {max(ready):.2f} s)")
    print("\n".join(await whole_run(folder_for(folder, "whole"))))


def main() -> int:
    """Read the options and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.resources", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--folder", help="where logs and summaries go")
    options = parser.parse_args()
    folder = Path(options.folder or tempfile.mkdtemp(prefix="zencell-resources-"))
    load, cores = os.getloadavg()[0], os.cpu_count()
    print(f"logs and summaries are in {folder}; {cores} cores, load {load:.1f} before it begins")
    asyncio.run(measure(folder))
    print("\n".join(environment()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
