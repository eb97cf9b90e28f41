"""Many seeds of one cell, several at a time, each in a process that has nothing else to do."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field

from common.config import Cell
from common.process.lifeline import die_when_orphaned
from lab.simulation import Outcome, Simulation

ENOUGH = 0.99  # share of the seeds that must end DONE
SEEDS_A_PROCESS = 50  # after which a process is begun anew


@dataclass
class Tally:
    """What became of all seeds so far."""

    outcomes: list[Outcome] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    checked: Counter[str] = field(default_factory=Counter)
    requests: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: Outcome) -> None:
        """Count one."""
        self.outcomes.append(outcome)
        self.faults += outcome.faults
        self.checked += outcome.checked
        self.requests += outcome.requests

    @property
    def done(self) -> int:
        """How many ended DONE."""
        return sum(outcome.ok for outcome in self.outcomes)

    @property
    def others(self) -> list[Outcome]:
        """Those that did not, by seed."""
        return sorted((o for o in self.outcomes if not o.ok), key=lambda o: o.seed)

    @property
    def passed(self) -> bool:
        """Whether nothing broke that must hold, no service crashed by itself, and enough ended DONE."""
        if any(outcome.broken or outcome.crashes for outcome in self.outcomes):
            return False
        return bool(self.outcomes) and self.done >= ENOUGH * len(self.outcomes)


def run_seeds(cell: Cell, seeds: Sequence[int], faults: bool, jobs: int, limit: float) -> Iterator[Outcome]:
    """The outcome of each seed as it comes; left early, no process stays behind.

    Args:
        cell: resolved.
        seeds: are run in this order, and come as they are done.
        faults: whether things go wrong.
        jobs: how many at a time.
        limit: virtual time in which each has to end [s].
    """
    some = SEEDS_A_PROCESS * min(jobs, len(seeds))
    # Not `max_tasks_per_child`: in Python 3.11 who is to be begun anew may never be (gh-115634), and all wait for ever.
    for first in range(0, len(seeds), some):
        yield from _run_some(cell, seeds[first:first + some], faults, jobs, limit)


def _run_some(cell: Cell, seeds: Sequence[int], faults: bool, jobs: int, limit: float) -> Iterator[Outcome]:
    pool = ProcessPoolExecutor(
        min(jobs, len(seeds)), multiprocessing.get_context("spawn"), _begin, (cell, faults, limit))
    running: dict[Future[Outcome], int] = {}
    try:
        running |= {pool.submit(_run, seed): seed for seed in seeds}
        for future in as_completed(running):
            try:
                yield future.result()
            except BrokenProcessPool:
                yield Outcome(running[future], "NO PROCESS", "a process that ran seeds was killed")
            except Exception as error:  # noqa: BLE001 - a seed that breaks the simulation itself is a finding too
                yield Outcome(running[future], "FAILED", f"{type(error).__name__}: {error}", broken=[str(error)])
        running.clear()
    finally:
        if running:  # left early: nobody waits for what has begun
            for process in multiprocessing.active_children():
                process.kill()
        pool.shutdown(cancel_futures=True)


_work: list[tuple[Cell, bool, float]] = []


def _begin(cell: Cell, faults: bool, limit: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who began us ends us
    die_when_orphaned()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _work[:] = [(cell, faults, limit)]


def _run(seed: int) -> Outcome:
    cell, faults, limit = _work[0]
    return Simulation(cell, seed, faults=faults, limit=limit).run()
