"""`check`, `doctor` and `simulate`: find faults of a cell or of this machine before a run."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from common.terminal import echo

if TYPE_CHECKING:
    from common.config import Cell


def check(
    cell: options.CellArgument, overrides: options.Overrides = None, world: options.WorldName = None,
    seed: options.Seed = None, as_json: options.Json = False,
) -> None:
    """Report what will not work in a cell: unreachable positions, blind cameras, keys without writer; exit 1 if any.

    Nothing is started and nothing moves. Exit 0 without errors, also with warnings.
    """
    from common.config import load_cell
    from tools.check.cell import examine

    loaded = load_cell(cell, tuple(overrides or ()), world=world, seed=options.whole("--seed", seed, 0))
    errors = warnings = 0
    for found in examine(loaded):
        errors, warnings = errors + (found.severity == "error"), warnings + (found.severity == "warning")
        if as_json:
            echo(json.dumps({"severity": found.severity, "what": found.what, "remedy": found.remedy,
                             "refused": found.refused}))
        else:
            echo(f"{found.severity:<7}  {found.line}")
    if not as_json:
        echo(f"{loaded.name}: {_counted(errors, 'error')}, {_counted(warnings, 'warning')}")
    if errors:
        raise typer.Exit(1)


def _counted(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'' if count == 1 else 's'}"


def doctor(
    domain: options.Domain = None, connect: options.Connect = None, as_json: options.Json = False
) -> None:
    """Check this machine and say how to fix each problem; exit 1 if a check fails."""
    from common.transport.endpoint import endpoint_of
    from tools.doctor.examination import examine

    failed = False
    for finding in examine(endpoint_of(domain, connect)):
        if as_json:
            echo(json.dumps(asdict(finding)))
        else:
            echo(f"{finding.level:<4}  {finding.what}{f': {finding.remedy}' if finding.remedy else ''}")
        failed |= finding.level == "fail"
    if failed:
        raise typer.Exit(1)


def simulate(
    cell: options.CellArgument,
    seeds: Annotated[str | None, typer.Option("--seeds", metavar="A-B", help="seeds to run [1-20]")] = None,
    seed: Annotated[str | None, typer.Option("--seed", metavar="N", help="run only this seed and print all "
                                                                         "events")] = None,
    faults: Annotated[bool, typer.Option("--faults", help="inject crashes, cut links and lost messages")] = False,
    doubles: Annotated[
        bool, typer.Option("--doubles", help="replace perception and planner by fast fakes, for many more "
                                             "seeds of task, executor and supervisor")
    ] = False,
    trace: Annotated[
        str | None, typer.Option("--trace", metavar="FILE.mcap", help="record all messages of the run of --seed")
    ] = None,
    jobs: Annotated[str | None, typer.Option("--jobs", metavar="N", help="number of parallel runs [one for each "
                                                                         "core]")] = None,
    limit: Annotated[
        str, typer.Option("--limit", metavar="S", help="virtual time limit of the task [s]")
    ] = "300",
    overrides: options.Overrides = None,
    world: options.WorldName = None,
) -> None:
    """Run a complete cell in one process on a virtual clock, once for each seed; check the invariants at every step.

    Exit code 0 only if no invariant is violated and 99 % of the seeds end DONE.
    """
    from common.config import load_cell
    from common.errors import ConfigError
    from common.process.environment import usable_cores
    from lab.campaign import seeds_of
    from lab.doubles import settings_of, with_doubles
    from lab.observers import with_observed_arm
    from tools.check.cell import require_task

    if seeds is not None and seed is not None:
        raise ConfigError("--seed", seed, "does not go with --seeds")
    if trace is not None and seed is None:
        raise ConfigError("--trace", trace, "needs --seed N")
    one = options.whole("--seed", seed, 0)
    all_seeds = seeds_of(seeds or "1-20")
    at_a_time = options.whole("--jobs", jobs, 1) or max(1, int(usable_cores()))
    longest = options.number("--limit", limit)
    if longest <= 0:
        raise ConfigError("--limit", limit, "must be more than 0 [s]")
    loaded = load_cell(cell, overrides or (), world=world)
    if doubles:
        settings = (*settings_of(loaded.application), *(overrides or ()))
        loaded = with_doubles(load_cell(cell, settings, world=world))
    require_task(loaded)
    with_observed_arm(loaded)  # raises an error if the cell cannot be simulated
    if one is None:
        raise typer.Exit(_campaign(loaded, all_seeds, faults, at_a_time, longest))
    raise typer.Exit(_single(loaded, one, faults, trace, longest))


def _single(cell: Cell, seed: int, faults: bool, file: str | None, limit: float) -> int:
    """Run one seed, print all events, and return the exit code."""
    from lab.campaign import format_outcome
    from lab.observers import Trace
    from lab.simulation import Simulation
    from recording.capture import CustomTopics
    from recording.formatting import about, require_new

    trace = None
    if file is not None:
        require_new(Path(file), "--trace")
        trace = Trace(Path(file), about(cell.name), CustomTopics.of(cell))
    simulation = Simulation(cell, seed, faults=faults, limit=limit, digest=True, trace=trace, log=echo)
    try:
        outcome = simulation.run()
    finally:
        if trace is not None:
            trace.close("simulated")
    for line in format_outcome(outcome):
        echo(line)
    if trace is not None:
        echo(f"recorded {trace.messages:,} messages: {file}")
    return 0 if outcome.ok and not outcome.crashes else 1


def _campaign(cell: Cell, seeds: Sequence[int], faults: bool, jobs: int, limit: float) -> int:
    """Run all seeds with a progress bar, print the table, and return the exit code."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from lab.campaign import Tally, failure_reason, run_seeds, table

    tally, interrupted = Tally(), False
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not sys.stderr.isatty(), transient=True) as progress:
        bar = progress.add_task(cell.name, total=len(seeds))
        try:
            for outcome in run_seeds(cell, seeds, faults, jobs, limit):
                tally.add(outcome)
                if not outcome.ok or outcome.crashes:
                    line = f"seed {outcome.seed}: {failure_reason(outcome)}"
                    console.print(line, markup=False, highlight=False, soft_wrap=True)
                progress.update(bar, advance=1, description=f"{cell.name} {tally.done} DONE")
        except KeyboardInterrupt:
            interrupted = True
    if tally.outcomes:
        Console(soft_wrap=True).print(table(cell.name, tally, faults))
    if interrupted:
        echo(f"interrupted after {len(tally.outcomes)} of {len(seeds)} seeds", err=True)
        return 130
    return 0 if tally.passed else 1
