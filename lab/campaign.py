"""Many seeds of one cell, several at a time, each in a process that has nothing else to do."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field

from rich.table import Table

from common.config import Cell
from common.errors import ConfigError
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


MOST_SEEDS = 1_000_000
SHOWN = 50  # seeds that did not end DONE, in the table


def seeds_of(text: str) -> range:
    """The seeds of A-B, or of a single number.

    Raises:
        ConfigError: it is neither.
    """
    match = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", text.strip())
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if not first <= last < first + MOST_SEEDS:
        raise ConfigError("--seeds", text, "must be a range such as 1-1000")
    return range(first, last + 1)


def format_outcome(outcome: Outcome) -> list[str]:
    """One seed in a few lines for people."""
    lines = [f"seed {outcome.seed}: {outcome.state}{f', {outcome.message}' if outcome.message else ''}"]
    lines.append(f"  {outcome.seconds:.1f} s of virtual time in {outcome.cpu_seconds:.1f} CPU seconds, "
                 f"{outcome.messages:,} messages, digest {outcome.digest}")
    lines.append(f"  faults: {listed(outcome.faults) or 'none'}")
    lines.append(f"  requests: {listed(outcome.requests)}")
    lines.append(f"  checked: {listed(outcome.checked)}")
    lines += [f"  broken: {what}" for what in outcome.broken]
    lines += [f"  crashed by itself: {what}" for what in outcome.crashes]
    return lines


def listed(counted: dict[str, int]) -> str:
    """Counts in one line, the largest first."""
    order = sorted(counted.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{name} {count:,}" for name, count in order)


def reason(outcome: Outcome) -> str:
    """Why a seed is no success."""
    crashes = [f"crashed by itself: {what}" for what in outcome.crashes[:1]]
    return "; ".join([f"{outcome.state} {outcome.message}".strip(), *outcome.broken[1:], *crashes])


def table(name: str, tally: Tally, faults: bool) -> Table:
    """All seeds in one table: how they ended, what went wrong on purpose, what was checked, and who failed."""
    outcomes = tally.outcomes
    ended = [outcome.seconds for outcome in outcomes if outcome.ok] or [0.0]
    cpu = [outcome.cpu_seconds for outcome in outcomes]
    made = Table(title=f"{name}, {len(outcomes)} seeds{' with faults' if faults else ''}", show_header=False)
    made.add_row("DONE", f"{tally.done} of {len(outcomes)} ({tally.done / len(outcomes):.1%})")
    made.add_row("virtual time", f"{statistics.median(ended):.1f} s (median), {max(ended):.1f} s at most")
    made.add_row("CPU time", f"{statistics.median(cpu):.1f} s a seed (median), {sum(cpu):.0f} s in all")
    made.add_row("requests", listed(tally.requests))
    made.add_section()
    if faults:
        for kind, count in sorted(tally.faults.items()):
            each = [outcome.faults[kind] for outcome in outcomes]
            made.add_row(f"fault: {kind}", f"{count:,} ({min(each)} to {max(each)} a run)")
        made.add_section()
    broken = [what for outcome in outcomes for what in outcome.broken]
    for what, count in sorted(tally.checked.items()):
        breaks = sum(what in line for line in broken)
        made.add_row(f"invariant: {what}", f"{count:,} looks, {f'BROKEN {breaks} times' if breaks else 'held'}")
    bad = [outcome for outcome in sorted(outcomes, key=lambda o: o.seed) if not outcome.ok or outcome.crashes]
    if bad:
        made.add_section()
    for outcome in bad[:SHOWN]:
        made.add_row(f"seed {outcome.seed}", reason(outcome))
    if len(bad) > SHOWN:
        made.add_row("...", f"{len(bad) - SHOWN} more")
    return made
