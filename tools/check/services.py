"""All findings of a cell, those among them that its services make when they are run until they would be ready."""

from __future__ import annotations

from collections.abc import Iterator

from common.config import Cell
from common.errors import ConfigError, ZencellError
from common.supervision.wiring import WiringFailed, wire_service
from tools.check.cell import quick, thorough
from tools.check.finding import Finding, error, refusal
from tools.check.wiring import Keys, check_wiring

SHOWS = "viewer"  # a page shows whatever there is


def examine(cell: Cell) -> Iterator[Finding]:
    """All findings of a cell, each once; the quick ones first."""
    told: set[str] = set()
    for found in (*quick(cell), *thorough(cell), *wiring(cell)):
        if not any(found.what.startswith(what) for what in told):  # a service says what was found here, too
            told.add(found.what)
            yield found


def wiring(cell: Cell) -> Iterator[Finding]:
    """What services refuse, a task that is none of them, and keys that do not fit together."""
    found, complete = [], True
    if cell.task not in cell.services:
        yield error(f"task: {cell.task!r} is no service of the cell, so that nothing ends a run",
                    f"name one of {', '.join(cell.services)}")
    for entry in cell.services.values():
        try:
            each = wire_service(cell, entry)
        except ConfigError as told:
            yield refusal(told)
        except WiringFailed as told:
            yield error(str(told), "correct the service, or its parameters", refused=True)
        except ZencellError as told:
            yield error(f"services.{entry.name}: {told}", "correct it", refused=True)
        else:
            found.append(Keys(each.name, each.reads, each.writes, each.serves, each.calls, entry.kind == SHOWS))
            continue
        complete = False
    for finding in check_wiring(found):
        if complete or finding.severity == "error":  # what a service that is refused would write is not known
            yield finding
