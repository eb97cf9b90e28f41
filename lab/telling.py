"""Simulated runs for people: which seeds are meant, one of them in full, and many in a table."""

from __future__ import annotations

import re
import statistics

from rich.table import Table

from common.errors import ConfigError
from lab.campaign import Tally
from lab.simulation import Outcome

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


def told(outcome: Outcome) -> list[str]:
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
