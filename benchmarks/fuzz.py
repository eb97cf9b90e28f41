"""Payloads by the million: does anything but a refusal come of them, and does a cell go on that gets them?

`python -m benchmarks.fuzz` changes payloads of all messages by a seed and decodes them; then it puts and asks what it
made under every key of both cells, on the virtual clock. With `--live SECONDS` it does so to a cell of real processes
as well, and compares the gaps in its joint states with those of as long a time in between without. Of each gap it says
whether the executor computed, waited for a processor, which is the machine's load, or was held up by something else.
Exit code 1 if anything but DecodeError was raised, a process ended, or there were more gaps without those in which the
executor waited for a processor.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import tempfile
import threading
import time
from bisect import bisect_left, bisect_right
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from common import topics
from common.application import all_topics
from common.config import load_cell
from common.errors import DecodeError
from common.messages.basics import SMALL, Message
from common.recording.stamps import stamp_of
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.codec import decode, decode_attachment
from common.transport.session import RawSample
from common.virtual.simulation import Simulation
from tests.harness import RunningCell, beside, until
from tests.mutations import Mutations, models

GAP = 0.05  # [s] between two joint states
ROUND = 60.0  # [s] of each side at once
AFTER = 1.0  # [s]
LOOK = 0.01  # [s] between two looks at what the executor spends
TOLD = 10  # findings that are printed in full
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
            if len(lines) < TOLD:
                lines.append(f"{model.__name__}: {type(error).__name__}: {error}: {payload[:200].hex()}")
        took = time.thread_time() - since
        if model.most_bytes <= SMALL and took > slowest.get(model.__name__, (0.0, 0))[0]:
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


class _Unheard(list[str]):
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
    simulation.invariants.broken = _Unheard()  # some payloads are valid: a ball more, a goal that nobody decided
    outcome = simulation.run()
    print(f"{name}, seed {seed}: {sent} payloads under its keys in {outcome.seconds:.0f} s of its time: "
          f"{outcome.state or 'no end'}, {len(outcome.crashes)} crashes, restarts {outcome.restarts}", flush=True)
    return [f"{name}, seed {seed}: {crash}" for crash in outcome.crashes]


class Spent(NamedTuple):
    """What the threads of a process have spent together until some time [ns]: computing, waiting for a processor.

    Waiting is also what a virtual machine does while its host has others run.
    """

    at: int
    computing: int
    waiting: int


def stolen() -> int:
    """Time [ns] in which the host of a virtual machine gave its processors to others, all of them together."""
    with suppress(OSError, IndexError):
        return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    return 0


class Spending:
    """Looks again and again, from a thread, at what a process spends; nothing where the system does not tell."""

    def __init__(self, pid: int) -> None:
        self._threads = Path(f"/proc/{pid}/task")
        self._ends = threading.Event()
        self.looks: list[Spent] = []
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Look no more."""
        self._ends.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._ends.wait(LOOK):
            began, computing, waiting = time.time_ns(), 0, 0
            for thread in self._threads.glob("[0-9]*"):
                with suppress(OSError):
                    told = (thread / "schedstat").read_text().split()
                    computing, waiting = computing + int(told[0]), waiting + int(told[1])
            waiting += stolen()
            self.looks.append(Spent((began + time.time_ns()) // 2, computing, waiting))

    def between(self, begin: int, end: int) -> tuple[float, float]:
        """Seconds that were spent computing, and waiting, from the last look before a time [ns] to the first after."""
        if not self.looks:
            return 0.0, 0.0
        first = self.looks[max(bisect_right(self.looks, begin, key=lambda look: look.at) - 1, 0)]
        last = self.looks[min(bisect_left(self.looks, end, key=lambda look: look.at), len(self.looks) - 1)]
        return (last.computing - first.computing) * 1e-9, (last.waiting - first.waiting) * 1e-9


@dataclass
class Side:
    """A cell for some time, with or without being attacked."""

    what: str
    seconds: float = 0.0
    states: int = 0
    computed: int = 0  # gaps
    waited: int = 0
    held: int = 0
    lost: int = 0
    longest: float = 0.0
    computing: float = 0.0  # [s] of the executor
    waiting: float = 0.0
    own: list[str] = field(default_factory=list)  # gaps that were not the machine's load

    @property
    def gaps(self) -> int:
        """All that are too long."""
        return self.computed + self.waited + self.held + self.lost

    def __str__(self) -> str:
        share, wait = (100 * part / max(self.seconds, 1e-9) for part in (self.computing, self.waiting))
        return (f"{self.what} {self.seconds:.0f} s: {self.states} joint states, {self.gaps} gaps above "
                f"{1e3 * GAP:.0f} ms, the longest {1e3 * self.longest:.0f} ms; the executor waited for a processor in "
                f"{self.waited}, computed in {self.computed}, was held up in {self.held}, and {self.lost} were lost on "
                f"the way; it computed {share:.0f} % of the time and waited {wait:.0f} %")


class Gaps:
    """Counts long gaps between the times at which joint states were taken, of those that arrive."""

    def __init__(self, bus: Bus, cell: str, executor: int) -> None:
        """Begin to; `executor` is the process that sends them."""
        self._taken: list[tuple[int, int]] = []  # stamp and number of each
        self._spending = Spending(executor)
        self._began = time.time_ns()
        self._subscribed = bus.raw_subscriber(f"{cell}/{topics.JOINT_STATES.key}", self._arrive)

    def _arrive(self, sample: RawSample) -> None:
        sent = decode_attachment(sample.attachment)
        if sent is not None and (stamp := stamp_of(sample.payload)):  # what is made up here says nothing of itself
            self._taken.append((stamp, sent.sequence))

    def add_to(self, side: Side) -> None:
        """Add what there was so far; no more is counted."""
        self._subscribed.undeclare()
        self._spending.end()
        now = time.time_ns()
        spent = self._spending.between(self._began, now)
        side.computing, side.waiting = side.computing + spent[0], side.waiting + spent[1]
        side.seconds += (now - self._began) * 1e-9
        side.states += len(self._taken)
        for (before, number), (after, following) in pairwise(self._taken):
            gap = (after - before) * 1e-9
            side.longest = max(side.longest, gap)
            if gap <= GAP:
                continue
            computing, waiting = self._spending.between(before, after)
            told = f"{side.what}: {1e3 * gap:.0f} ms, {1e3 * computing:.0f} computing, {1e3 * waiting:.0f} waiting"
            if following - number != 1:
                side.lost += 1
            elif computing > gap / 2:
                side.computed += 1
                side.own.append(told)
            elif computing + waiting > gap / 2:
                side.waited += 1
            else:
                side.held += 1
                side.own.append(told)


async def live(options: argparse.Namespace, folder: Path) -> list[str]:
    """Compare a cell that is attacked with itself in between; a line for each thing that is worse."""
    rounds = max(1, round(options.live / ROUND))
    seconds = options.live / rounds
    calm, attacked = Side("left alone"), Side("attacked")
    mutations = Mutations(options.seed)
    with RunningCell(folder, "up", "panda") as cell:
        async with cell.listen() as bus, cell.listen() as attacker:
            await until(bus.reader(topics.MOTION_STATUS), lambda status: status.progress > 0, 120.0)
            before = cell.processes()
            memory = {name: process.memory_info().rss for name, process in before.items()}
            executor = before["trajectory_executor"].pid
            for _ in range(rounds):
                gaps = Gaps(bus, "panda", executor)
                await asyncio.sleep(seconds)
                gaps.add_to(calm)
                gaps = Gaps(bus, "panda", executor)
                async with beside(attack(attacker, mutations, "panda", options.pause, acts=options.acts)):
                    await asyncio.sleep(seconds)
                gaps.add_to(attacked)
                await asyncio.sleep(AFTER)  # until what was asked last is answered
            after = cell.processes()
            print(calm, attacked, *calm.own, *attacked.own, sep="\n")
            print("memory [MB]: " + ", ".join(
                f"{name} {memory[name] * 1e-6:.0f} -> {process.memory_info().rss * 1e-6:.0f}"
                for name, process in after.items() if name in memory), flush=True)
        wrong = [f"{name} ended: {folder}" for name, process in before.items()
                 if name not in after or after[name].pid != process.pid]
        own, own_before = len(attacked.own) + attacked.lost, len(calm.own) + calm.lost
        if own > own_before:
            wrong.append(f"{own} gaps in joint states without waiting for a processor, {own_before} when left alone")
        cell.interrupt()
        await cell.ended(30.0)
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
