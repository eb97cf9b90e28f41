"""Payloads by the million: does anything but a refusal come of them, and does a cell go on that gets them?

`python -m benchmarks.fuzz` changes payloads of all messages by a seed and decodes them; then it puts and asks what it
made under every key of both cells, on the virtual clock. With `--live SECONDS` it does so to a cell of real processes
as well, and compares the gaps in its joint states with those of an undisturbed cell next to it. For each gap it
reports whether the executor computed, waited for a processor (the load of the machine), or was blocked.
Exit code 1 if anything but DecodeError was raised, a process ended, memory grew, or there were more gaps, without those
in which the executor waited for a processor.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from benchmarks.soak import Seen, keep_busy, look_at
from common import topics
from common.application import all_topics
from common.config import load_cell
from common.errors import DecodeError
from common.messages.basics import SMALL_BYTES, Message
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.codec import decode
from lab.simulation import Simulation
from tests.gaps import Gaps, Side
from tests.harness import RunningCell, running_with, until
from tests.mutations import Mutations, models

CELL = "panda"  # of real processes
ROUND = 60.0  # [s] for which gaps are gathered before they are counted
AFTER = 1.0  # [s]
LEAST = 20  # rounds after which memory must have come to rest
MOST_GROWTH, MOST_MEGABYTES = 0.05, 3.0  # of it in the last three quarters
SHOWN = 10  # findings that are printed in full
PAUSE = 0.002  # [s] of virtual time between two payloads
SECONDS = 60.0  # of virtual time
SHY = ("supervisor/status",)  # what the visit itself lives by


def decoded(count: int, seed: int) -> list[str]:
    """Decode so many payloads; a line for each finding."""
    mutations, found = Mutations(seed), Counter[str]()
    every = models()
    slowest: dict[str, tuple[float, int]] = {}
    read, began = 0, time.process_time()
    lines: list[str] = []
    for i in range(count):
        model = every[i % len(every)]
        payload = mutations.payload(model)
        since = time.thread_time()
        try:
            decode(model, payload)
            read += 1
        except DecodeError:
            pass
        except BaseException as error:  # which is what this looks for
            found[f"{model.__name__}: {type(error).__name__}"] += 1
            if len(lines) < SHOWN:
                lines.append(f"{model.__name__}: {type(error).__name__}: {error}: {payload[:200].hex()}")
        took = time.thread_time() - since
        if model.max_bytes <= SMALL_BYTES and took > slowest.get(model.__name__, (0.0, 0))[0]:
            slowest[model.__name__] = min(took, again(model, payload)), len(payload)
    seconds = time.process_time() - began
    name, (most, size) = max(slowest.items(), key=lambda item: item[1])
    print(f"{count} payloads of {len(every)} messages in {seconds:.0f} s of CPU time: {read} read, "
          f"{count - read - found.total()} refused, {found.total()} something else; the slowest of a small message: "
          f"{1e3 * most:.2f} ms ({name}, {size} bytes)", flush=True)
    return [*lines, *(f"{count} times {what}" for what, count in found.items())]


def again(model: type[Message], payload: bytes) -> float:
    """Seconds of CPU time that the payload takes a second time: without a look of the garbage collector at all else."""
    since = time.thread_time()
    with suppress(DecodeError):
        decode(model, payload)
    return time.thread_time() - since


def _is_valid(model: type[Message], payload: bytes) -> bool:
    try:
        decode(model, payload)
    except DecodeError:
        return False
    return True


async def attack(bus: Bus, mutations: Mutations, cell: str, pause: float, *, acts: bool) -> None:
    """Put and ask what the mutations give under each key of the cell, one after the other, for ever.

    Some payloads are still valid. With `acts`, requests among them are asked too: stops, goals, a ball more.
    """
    writers: dict[str, Any] = {}
    while True:
        for topic in all_topics().values():
            key = f"{cell}/{topic.key.replace(topics.SERVICE, 'camera_simulator')}"
            if topic.key in SHY:
                continue
            payload = mutations.payload(topic.message)
            if isinstance(topic, Topic):
                if key not in writers:
                    writers[key] = bus.raw_publisher(key, "application/msgpack", reliable=topic.kind != "stream")
                writers[key].put(payload, b"")
            elif payload and (acts or not _is_valid(topic.message, payload)):
                asyncio.get_running_loop().create_task(bus.raw_get(key, 0.5, payload=payload))
            await asyncio.sleep(pause)


class _Ignored(list[str]):
    """A list that stays empty."""

    def append(self, item: str) -> None:
        """Leave it."""


def simulated(name: str, seed: int) -> list[str]:
    """Attack a cell on the virtual clock until its task ends or does not; a line for each process that ended."""
    sent = 0

    async def visit(bus: Bus) -> None:
        mutations = Mutations(seed)
        make = mutations.payload

        def counted(model: Any) -> bytes:
            nonlocal sent
            sent += 1
            return make(model)

        mutations.payload = counted  # type: ignore[method-assign]
        await attack(bus, mutations, name, PAUSE, acts=True)

    simulation = Simulation(load_cell(name, ["services.viewer.port=0"]), seed, limit=SECONDS, visit=visit)
    simulation.invariants.checks.broken = _Ignored()  # some payloads are valid: another ball, an unplanned goal
    outcome = simulation.run()
    print(f"{name}, seed {seed}: {sent} payloads under its keys in {outcome.seconds:.0f} s of its time: "
          f"{outcome.state or 'no end'}, {len(outcome.crashes)} crashes, restarts {outcome.restarts}", flush=True)
    return [f"{name}, seed {seed}: {crash}" for crash in outcome.crashes]


@asynccontextmanager
async def working(folder: Path, name: str) -> AsyncIterator[tuple[RunningCell, Bus]]:
    """A cell of real processes that clears its table again and again, in a folder of its own, and who listens to it."""
    (folder / name).mkdir()
    with RunningCell(folder / name, "up", CELL) as cell:
        async with cell.listen() as bus:
            await until(bus.reader(topics.MOTION_STATUS), lambda status: status.progress > 0, 120.0)
            async with running_with(keep_busy(bus, Seen())):
                yield cell, bus
        cell.interrupt()
        await cell.ended(30.0)


def private(processes: dict[str, psutil.Process]) -> dict[str, float]:
    """Memory that each has for itself [MB]; what has just ended is left out."""
    sizes = {}
    for name, process in processes.items():
        with suppress(psutil.Error, FileNotFoundError):
            sizes[name] = look_at(process).private * 1e-6
    return sizes


async def live(options: argparse.Namespace, folder: Path) -> list[str]:
    """Compare an attacked cell with an undisturbed one next to it; return a line for each figure that is worse."""
    rounds = max(1, round(options.live / ROUND))
    calm, attacked = Side("left alone"), Side("attacked")
    async with working(folder, "alone") as (alone, quiet), working(folder, "attacked") as (cell, bus):
        async with cell.listen() as attacker:
            before = cell.processes()
            memory = [private(before)]
            executors = [one.processes()["trajectory_executor"].pid for one in (alone, cell)]
            async with running_with(attack(attacker, Mutations(options.seed), CELL, options.pause, acts=options.acts)):
                for _ in range(rounds):
                    both = [Gaps(one, CELL, executor) for one, executor in zip((quiet, bus), executors, strict=True)]
                    await asyncio.sleep(options.live / rounds)
                    for gaps, side in zip(both, (calm, attacked), strict=True):
                        gaps.add_to(side)
                    memory.append(private(cell.processes()))
            await asyncio.sleep(AFTER)  # until what was asked last is answered
            after = cell.processes()
        print(calm, attacked, *calm.own, *attacked.own, sep="\n")
    wrong = [f"{name} ended: {folder}" for name, process in before.items()
             if name not in after or after[name].pid != process.pid]
    at = [0, rounds // 4, rounds // 2, rounds]
    grown = {name: [memory[number].get(name, 0.0) for number in at] for name in before}
    print("memory of what was attacked, at the begin, after a quarter, a half, and at the end [MB]: " + ", ".join(
        f"{name} {' '.join(f'{size:.1f}' for size in sizes)}" for name, sizes in grown.items()), flush=True)
    wrong += [f"{name} grew from {sizes[1]:.1f} MB after a quarter to {sizes[3]:.1f}" for name, sizes in grown.items()
              if rounds >= LEAST and sizes[3] - sizes[1] > max(MOST_GROWTH * sizes[1], MOST_MEGABYTES)]
    own, own_before = len(attacked.own) + attacked.lost, len(calm.own) + calm.lost
    if own > own_before:
        wrong.append(f"{own} gaps in joint states without waiting for a processor, {own_before} when left alone")
    return wrong


def main() -> int:
    """Read the options and run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--payloads", type=int, default=1_000_000, help="that are decoded")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", type=int, default=1, help="of each cell on the virtual clock")
    parser.add_argument("--live", type=float, default=0.0, metavar="SECONDS", help="against a cell of real processes")
    parser.add_argument("--acts", action="store_true", help="ask what is still a valid request of it too")
    parser.add_argument("--pause", type=float, default=0.005, metavar="SECONDS", help="between two payloads of it")
    options = parser.parse_args()
    wrong = decoded(options.payloads, options.seed) if options.payloads else []
    for seed in range(options.seed, options.seed + options.runs):
        wrong += [line for name in ("panda", "ur5") for line in simulated(name, seed)]
    if options.live:
        wrong += asyncio.run(live(options, Path(tempfile.mkdtemp(prefix="zencell-fuzz-"))))
    print("\n".join(wrong) or "nothing but refusals")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
