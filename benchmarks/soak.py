"""A Panda cell that works for a long time next to a slow and a stuck subscriber: does anything grow or get lost?

`python -m benchmarks.soak` takes 30 minutes at speed 1 with the camera at 30 Hz. Exit code 1 unless, after the first
5 minutes, memory grows by less than 2 % and descriptors not at all, nothing of a state or event topic is lost, nor a
joint state or transform, joint states keep their rate and the task continues placing. The machine must have room: at a
load of 20 on two cores nothing is lost, but joint states are written at 89 Hz.

Memory is what a process has for itself (anonymous and shared pages, also those swapped out): pages of files, such as
libraries, come and go with whatever else runs on the machine. Growth is the lower quartile of the last fifth of the
looks against that of the first fifth, of those after the first minutes: what a process holds between two pictures, and
not the two or three of 0.9 MB that happen to be under way. Those who handle pictures may keep two more in pieces: the C
library leaves up to twice the largest piece that was given back at the top of its store. The router has a descriptor or
two more while a subscriber that it has dropped connects again: of its own count those that are left when both are gone.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median

import psutil

from applications.pick_place.topics import PICK_PLACE_STATUS
from common import topics
from common.application import all_topics
from common.errors import RequestFailed
from common.messages import WorldEdit
from common.transport.bus import Bus
from tests.cells.losses import Losses
from tests.cells.subscribers import Subscriber
from tests.harness import LOG, RunningCell, running_with, until

CELL = "panda"
PERIOD = 10.0  # [s] between looks
MOST_GROWTH = 0.02
MOST_BYTES = 1e6  # a process may grow by so much: pieces of the allocator
PICTURE = 640 * 480 * 3  # [bytes]
ROUTER, GONE = "router", 30.0  # [s] until it has noticed that a subscriber is gone
HANDLES_PICTURES = ("camera_simulator", "vision_detector")
WINDOW = 5  # the first and the last of so many parts are compared
JOINT_RATE = 100.0  # [Hz]
LEAST_RATE = 0.95  # of it
FROZEN, AWAKE = 25.0, 5.0  # [s] the stuck subscriber is dropped by the router meanwhile and has to come back
PATIENCE = 10.0  # [s] for the task to see that there is work again
PLACING = 120.0  # [s] in which the task has to place something


@dataclass
class Look:
    """One process at one time."""

    private: float  # [bytes]
    pss: float  # [bytes]
    descriptors: int
    threads: int


@dataclass
class Seen:
    """What was seen of a cell in a soak."""

    looks: dict[str, list[Look]] = field(default_factory=lambda: defaultdict(list))
    loads: list[float] = field(default_factory=list)
    placed: list[tuple[float, int]] = field(default_factory=list)  # time [s, monotonic] and number so far
    resets: int = 0
    failures: int = 0
    restarts: int = 0
    dropped: Counter[tuple[str, str]] = field(default_factory=Counter)  # service and key
    overflow: Counter[tuple[str, str]] = field(default_factory=Counter)
    invalid: Counter[tuple[str, str]] = field(default_factory=Counter)


def look_at(process: psutil.Process) -> Look:
    """Memory, descriptors and threads of a process, now."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{process.pid}/status").read_text(encoding="ascii").splitlines()
    )
    private = sum(int(status[name].split()[0]) for name in ("RssAnon", "RssShmem", "VmSwap")) * 1024
    return Look(private, process.memory_full_info().pss, process.num_fds(), process.num_threads())


async def watch_processes(cell: RunningCell, seen: Seen, period: float) -> None:
    """Look at each process again and again."""
    processes: dict[str, psutil.Process] = {}
    while True:
        await asyncio.sleep(period)
        now = {**cell.processes(), "supervisor": psutil.Process(cell.process.pid)}
        seen.restarts += sum(name in processes and processes[name] != one for name, one in now.items())
        processes = now
        for name, process in now.items():
            try:
                seen.looks[name].append(look_at(process))
            except (psutil.Error, FileNotFoundError):
                continue
        seen.loads.append(os.getloadavg()[0])


async def keep_busy(bus: Bus, seen: Seen) -> None:
    """Put all balls back on the table whenever the task has cleared it."""
    status, edit, again = bus.reader(PICK_PLACE_STATUS), bus.client(topics.WORLD_EDIT), 0.0
    async for message in status:
        seen.failures = message.failures
        if not seen.placed or seen.placed[-1][1] != message.placed:
            seen.placed.append((time.monotonic(), message.placed))
        if message.state == "DONE" and time.monotonic() > again:
            # A cell that does not answer now may answer later; missing placements are reported at the end.
            with suppress(RequestFailed):
                await edit.call(WorldEdit(op="reset"), 5.0)
                seen.resets += 1
            again = time.monotonic() + PATIENCE


async def count(bus: Bus, seen: Seen) -> None:
    """Note what the services have dropped, lost and refused so far."""
    async for counters in bus.reader(topics.COUNTERS):
        for into, counted in ((seen.dropped, counters.dropped), (seen.overflow, counters.overflow),
                           (seen.invalid, counters.invalid)):
            for key, number in counted.items():
                into[counters.service, key] = number


async def freeze_and_wake(subscriber: Subscriber) -> None:
    """Keep a subscriber stuck: a frozen one is dropped by the router after a while, so it is let back now and then."""
    while True:
        subscriber.freeze()
        await asyncio.sleep(FROZEN)
        subscriber.wake()
        await asyncio.sleep(AWAKE)


def lower_quartile(values: Sequence[float]) -> float:
    """Of a few values, the one that a quarter of them is below."""
    return sorted(values)[len(values) // 4]


def growth(
    values: Sequence[float], of: Callable[[Sequence[float]], float] = lower_quartile
) -> tuple[float, float]:
    """What the first and the last part of the values come to."""
    size = max(1, len(values) // WINDOW)
    return of(values[:size]), of(values[-size:])


def report(seen: Seen, losses: Losses, settle: float, period: float) -> tuple[list[str], list[str]]:
    """The tables as lines, and what is wrong."""
    wrong: list[str] = []
    skipped = round(settle / period)
    lines = ["", "| process | memory first [MB] | last [MB] | growth | PSS last [MB] | descriptors | threads |",
             "|---|---|---|---|---|---|---|"]
    all_first = all_last = 0.0
    for name, all_looks in seen.looks.items():
        looks = all_looks[skipped:]
        if len(looks) < WINDOW:
            wrong.append(f"{name} was looked at {len(looks)} times only")
            continue
        first, last = growth([look.private for look in looks])
        fds, threads = growth([look.descriptors for look in looks], max), growth([look.threads for look in looks])
        all_first, all_last = all_first + first, all_last + last
        lines.append(
            f"| {name} | {first / 1e6:.1f} | {last / 1e6:.1f} | {last / first - 1:+.2%} | {looks[-1].pss / 1e6:.0f} | "
            f"{fds[0]:g} → {fds[1]:g} | {threads[0]:g} → {threads[1]:g} |"
        )
        room = MOST_BYTES + (2 * PICTURE if name in HANDLES_PICTURES else 0)
        if last - first > max(MOST_GROWTH * first, room):
            wrong.append(f"memory of {name} grew from {first / 1e6:.1f} to {last / 1e6:.1f} MB")
        if fds[1] > fds[0] and name != ROUTER:
            wrong.append(f"descriptors of {name} grew from {fds[0]:g} to {fds[1]:g}")
    if all_first:
        more = all_last / all_first - 1
        lines.append(f"| together | {all_first / 1e6:.1f} | {all_last / 1e6:.1f} | {more:+.2%} | | | |")
        if more > MOST_GROWTH:
            wrong.append(f"memory grew by {more:.2%}")
    lines += ["", *losses.table(), "", *_counted(seen, wrong)]
    lost = {key: one.lost for key, one in losses.of.items() if one.lost}
    wrong += [f"{number} messages of {key} were lost on the way" for key, number in lost.items()]
    joints = losses.of[topics.JOINT_STATES.key]
    if joints.rate < LEAST_RATE * JOINT_RATE:
        wrong.append(f"joint states came at {joints.rate:.1f} Hz")
    return lines, wrong


def _counted(seen: Seen, wrong: list[str]) -> list[str]:
    """Lines on what the readers of the services counted."""
    kinds = {key: topic.kind for key, topic in all_topics().items()}
    lines = ["| readers of | replaced unread | overflow | refused |", "|---|---|---|---|"]
    for kind in ("stream", "state", "event"):
        dropped, overflow, invalid = (
            {pair: number for pair, number in counter.items() if kinds.get(pair[1]) == kind}
            for counter in (seen.dropped, seen.overflow, seen.invalid)
        )
        sums = [sum(counted.values()) for counted in (dropped, overflow, invalid)]
        lines.append(f"| {kind} topics | {sums[0]} | {sums[1]} | {sums[2]} |")
        if kind != "stream":
            lines += [f"| {service}: {key} | {number} | | |" for (service, key), number in sorted(dropped.items())]
        wrong += [f"{number} messages of {key} overflowed in {service}" for (service, key), number in overflow.items()]
        wrong += [f"{service} refused {number} messages of {key}" for (service, key), number in invalid.items()]
    return lines


@asynccontextmanager
async def disturbed(endpoint: str) -> AsyncIterator[None]:
    """A slow and a stuck subscriber to everything, during the block."""
    with Subscriber(endpoint, f"{CELL}/**", 1.0), Subscriber(endpoint, f"{CELL}/**", 0) as stuck:
        async with running_with(freeze_and_wake(stuck)):
            yield


def descriptors_of_router(cell: RunningCell) -> int:
    """How many it has now; 0 when it is gone."""
    router = cell.processes().get(ROUTER)
    return router.num_fds() if router is not None else 0


async def descriptors_left(cell: RunningCell, before: int) -> int:
    """Return the number of sessions of the router, after it had time to notice closed ones."""
    for _ in range(round(GONE)):
        if descriptors_of_router(cell) <= before:
            break
        await asyncio.sleep(1.0)
    return descriptors_of_router(cell)


async def until_over(cell: RunningCell, seen: Seen, end: float) -> None:
    """Wait for the end [s, monotonic] or for that of the cell, and print the state each minute."""
    while (left := end - time.monotonic()) > 0 and cell.process.poll() is None:
        await asyncio.sleep(min(60.0, left))
        memory = sum(looks[-1].private for looks in seen.looks.values())
        placed = seen.placed[-1][1] if seen.placed else 0
        print(f"{max(0.0, end - time.monotonic()) / 60:.0f} min left: {placed} placed, {seen.resets} resets, "
              f"{memory / 1e6:.0f} MB, load {os.getloadavg()[0]:.1f}", flush=True)


async def soak(options: argparse.Namespace, folder: Path) -> int:
    """Run, print what was seen, and 0 if all of it is good."""
    seen = Seen()
    with RunningCell(folder, "up", CELL, "--set", "services.camera_simulator.rate=30") as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), lambda status: status.progress > 0, 120.0)
            losses = Losses(bus)
            end = time.monotonic() + options.minutes * 60
            watching = (watch_processes(cell, seen, options.period), keep_busy(bus, seen), count(bus, seen))
            disturbance = nullcontext() if options.alone else disturbed(cell.endpoint)
            before = descriptors_of_router(cell)
            async with disturbance, running_with(*watching):
                await until_over(cell, seen, end)
                losses.stop()
            left = await descriptors_left(cell, before)
            ended_early = cell.process.poll() is not None
        cell.interrupt()
        code = await cell.ended(30.0)
    lines, wrong = report(seen, losses, options.settle * 60, options.period)
    if left > before:
        wrong.append(f"descriptors of {ROUTER} grew from {before} to {left}, subscribers gone")
    placed = seen.placed[-1][1] - seen.placed[0][1] if seen.placed else 0
    times = [*(at for at, _ in seen.placed), end]
    idle = max((b - a for a, b in pairwise(times)), default=math.inf)
    if idle > PLACING:
        wrong.append(f"nothing was placed for {idle:.0f} s")
    if ended_early or code:
        wrong.append(f"the cell ended with {code}; its log is {folder / LOG}")
    print("\n".join(lines))
    print(f"\n{options.minutes:g} minutes: {placed} balls placed in {seen.resets + 1} rounds, at most {idle:.0f} s "
          f"between two; {seen.failures} failures, {seen.restarts} processes started again; load of the machine "
          f"{min(seen.loads):.1f} to {max(seen.loads):.1f}, median {median(seen.loads):.1f}, {os.cpu_count()} cores")
    looks = {name: [asdict(look) for look in looks] for name, looks in seen.looks.items()}
    (folder / "looks.json").write_text(json.dumps(looks))
    print("\n".join(wrong) or "nothing grows, nothing is lost")
    return 1 if wrong else 0


def main() -> int:
    """Read the options and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--settle", type=float, default=5.0, help="minutes before memory is compared")
    parser.add_argument("--period", type=float, default=PERIOD, help="seconds between looks")
    parser.add_argument("--folder", help="where log and looks go")
    parser.add_argument("--alone", action="store_true", help="without the slow and the stuck subscriber")
    options = parser.parse_args()
    folder = Path(options.folder or tempfile.mkdtemp(prefix="zencell-soak-"))
    print(f"log and looks are in {folder}", flush=True)
    return asyncio.run(soak(options, folder))


if __name__ == "__main__":
    raise SystemExit(main())
