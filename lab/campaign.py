"""Many seeds of one cell, in parallel worker processes, and reports about them."""

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
SEEDS_A_PROCESS = 50  # after which a worker process is replaced
MOST_SEEDS = 1_000_000
SHOWN = 50  # failed seeds listed in the table


@dataclass
class Tally:
    """Outcomes of all seeds so far."""

    outcomes: list[Outcome] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    checked: Counter[str] = field(default_factory=Counter)
    requests: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.outcomes.append(outcome)
        self.faults += outcome.faults
        self.checked += outcome.checked
        self.requests += outcome.requests

    @property
    def done(self) -> int:
        """Number of seeds that ended DONE or LEFT."""
        return sum(outcome.ok for outcome in self.outcomes)

    @property
    def others(self) -> list[Outcome]:
        """The other seeds in order."""
        return sorted((o for o in self.outcomes if not o.ok), key=lambda o: o.seed)

    @property
    def passed(self) -> bool:
        """Whether all invariants held, no service crashed by itself, and enough seeds ended DONE."""
        if any(outcome.broken or outcome.crashes for outcome in self.outcomes):
            return False
        return bool(self.outcomes) and self.done >= ENOUGH * len(self.outcomes)


def run_seeds(cell: Cell, seeds: Sequence[int], faults: bool, jobs: int, limit: float) -> Iterator[Outcome]:
    """Yield the outcome of each seed as it ends; closing the iterator kills the workers.

    Args:
        cell: resolved.
        seeds: started in this order.
        faults: whether faults are injected.
        jobs: number of worker processes.
        limit: virtual time in which each run must end [s].
    """
    batch = SEEDS_A_PROCESS * min(jobs, len(seeds))
    # `max_tasks_per_child` would do the same, but in Python 3.11 it can deadlock (gh-115634).
    for first in range(0, len(seeds), batch):
        yield from _run_batch(cell, seeds[first:first + batch], faults, jobs, limit)


def _run_batch(cell: Cell, seeds: Sequence[int], faults: bool, jobs: int, limit: float) -> Iterator[Outcome]:
    pool = ProcessPoolExecutor(
        min(jobs, len(seeds)), multiprocessing.get_context("spawn"), _initialize, (cell, faults, limit))
    running: dict[Future[Outcome], int] = {}
    try:
        running |= {pool.submit(_run, seed): seed for seed in seeds}
        for future in as_completed(running):
            try:
                yield future.result()
            except BrokenProcessPool:
                yield Outcome(running[future], "NO PROCESS", "the worker process of this seed was killed")
            except Exception as error:  # noqa: BLE001 - a seed that breaks the simulation itself is a finding too
                yield Outcome(running[future], "FAILED", f"{type(error).__name__}: {error}", broken=[str(error)])
        running.clear()
    finally:
        if running:  # closed early
            for process in multiprocessing.active_children():
                process.kill()
        pool.shutdown(cancel_futures=True)


_job: list[tuple[Cell, bool, float]] = []


def _initialize(cell: Cell, faults: bool, limit: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    die_when_orphaned()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _job[:] = [(cell, faults, limit)]


def _run(seed: int) -> Outcome:
    cell, faults, limit = _job[0]
    return Simulation(cell, seed, faults=faults, limit=limit).run()


def seeds_of(text: str) -> range:
    """Return the seeds of `A-B`, or of a single number.

    Raises:
        ConfigError: the text is neither.
    """
    match = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", text.strip())
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if not first <= last < first + MOST_SEEDS:
        raise ConfigError("--seeds", text, "must be a range such as 1-1000")
    return range(first, last + 1)


def format_outcome(outcome: Outcome) -> list[str]:
    """Return the report of one seed as lines."""
    lines = [f"seed {outcome.seed}: {outcome.state}{f', {outcome.message}' if outcome.message else ''}"]
    lines.append(f"  {outcome.seconds:.1f} s of virtual time in {outcome.cpu_seconds:.1f} CPU seconds, "
                 f"{outcome.messages:,} messages, digest {outcome.digest}")
    lines.append(f"  faults: {format_counts(outcome.faults) or 'none'}")
    lines.append(f"  requests: {format_counts(outcome.requests)}")
    lines.append(f"  checked: {format_counts(outcome.checked)}")
    lines += [f"  broken: {violation}" for violation in outcome.broken]
    lines += [f"  crashed by itself: {crash}" for crash in outcome.crashes]
    return lines


def format_counts(counts: dict[str, int]) -> str:
    """Return counts in one line, the largest first."""
    order = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{name} {count:,}" for name, count in order)


def failure_reason(outcome: Outcome) -> str:
    """Return why a seed failed."""
    crashes = [f"crashed by itself: {crash}" for crash in outcome.crashes[:1]]
    return "; ".join([f"{outcome.state} {outcome.message}".strip(), *outcome.broken[1:], *crashes])


def table(name: str, tally: Tally, faults: bool) -> Table:
    """Return a table of all seeds: how they ended, injected faults, checks, and the failed seeds with reasons."""
    outcomes = tally.outcomes
    ended = [outcome.seconds for outcome in outcomes if outcome.ok] or [0.0]
    cpu = [outcome.cpu_seconds for outcome in outcomes]
    rows = Table(title=f"{name}, {len(outcomes)} seeds{' with faults' if faults else ''}", show_header=False)
    rows.add_row("DONE", f"{tally.done} of {len(outcomes)} ({tally.done / len(outcomes):.1%})")
    rows.add_row("virtual time", f"{statistics.median(ended):.1f} s (median), {max(ended):.1f} s at most")
    rows.add_row("CPU time", f"{statistics.median(cpu):.1f} s a seed (median), {sum(cpu):.0f} s in all")
    rows.add_row("requests", format_counts(tally.requests))
    rows.add_section()
    if faults:
        for kind, count in sorted(tally.faults.items()):
            each = [outcome.faults[kind] for outcome in outcomes]
            rows.add_row(f"fault: {kind}", f"{count:,} ({min(each)} to {max(each)} a run)")
        rows.add_section()
    broken = [violation for outcome in outcomes for violation in outcome.broken]
    for invariant, count in sorted(tally.checked.items()):
        breaks = sum(invariant in line for line in broken)
        rows.add_row(f"invariant: {invariant}", f"{count:,} checks, {f'BROKEN {breaks} times' if breaks else 'held'}")
    failed = [outcome for outcome in sorted(outcomes, key=lambda o: o.seed) if not outcome.ok or outcome.crashes]
    if failed:
        rows.add_section()
    for outcome in failed[:SHOWN]:
        rows.add_row(f"seed {outcome.seed}", failure_reason(outcome))
    if len(failed) > SHOWN:
        rows.add_row("...", f"{len(failed) - SHOWN} more")
    return rows
