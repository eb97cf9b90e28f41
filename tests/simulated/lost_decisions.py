"""Bugs of operators' interlocks, each put back into the fixed code, and the seeds with doubles that find it.

`python -m tests.simulated.lost_decisions [SEEDS] [NAMES]` prints the table.
"""

import contextlib
import sys
from unittest.mock import patch

from common.config import load_cell
from common.control.interlocks import InterlockFile, Interlocks, Record
from common.transport.ownership import Ownership
from lab.doubles import settings_of, with_doubles
from lab.simulation import Simulation
from services import trajectory_executor


def _without(**left_out):
    honest = InterlockFile.load

    def load(self):
        record, problem = honest(self)
        stops = {"interlocks": [i for i in record.interlocks if i.kind != "held"]} if "interlocks" in left_out else {}
        return record.model_copy(update=left_out | stops), problem

    return patch.object(InterlockFile, "load", load)


def _let_in():
    async def allow(self, *_):
        return None

    return patch.object(Ownership, "_require_only", allow)


def _late_start_counts():
    return patch("common.control.interlocks._releases", lambda request, interlock: (
        request.override or (request.stops if interlock.kind == "stopped" else True)))


DECISIONS = {
    "a restart forgets the stop": lambda: patch.object(InterlockFile, "load", lambda self: (Record(), "")),
    "the hold's record is not read": lambda: _without(interlocks=[]),
    "a remembered stop of an unknown goal is forgotten": lambda: patch.object(
        Interlocks, "block_goals", lambda self, goals: None),
    "the speed is forgotten": lambda: patch.object(
        trajectory_executor, "effective_speed", lambda saved, configured: configured),
    "a second instance is let in": _let_in,
    "a start undoes a later stop": _late_start_counts,
}


def found_in(name, bug, seeds, enough=None):
    """Return the seeds that find the bug, until there are enough, and the report of the first."""
    application = load_cell(name).application
    cell, found, first = with_doubles(load_cell(name, settings_of(application))), [], ""
    for seed in seeds:
        with DECISIONS[bug]():
            outcome = Simulation(cell, seed, faults=True, limit=60.0).run()
        assert not any("TypeError" in crash for crash in outcome.crashes), f"it was put back wrongly: {outcome.crashes}"
        if not outcome.ok or outcome.crashes:
            found.append(seed)
            first = first or f"{outcome.state} {outcome.message}"
            if len(found) == enough:
                break
    return found, first


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    for bug in sys.argv[2:] or DECISIONS:
        seeds, report = found_in("panda", bug, range(1, count + 1))
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.write(f"{bug}: {len(seeds)} of {count}, first {seeds[:1]}: {report}\n")
            sys.stdout.flush()
