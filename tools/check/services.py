"""All findings of a cell, including those of its services when they are run until ready, and of their keys."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from difflib import get_close_matches
from typing import NamedTuple

from common.config import Cell
from common.errors import ConfigError, ZencellError
from common.supervision.wiring import WiringFailed, wire_service
from common.transport import ownership
from common.transport.ownership import SHARED, Owner
from tools.check import Finding, error, refusal, warning
from tools.check.cell import check_files, check_model

VIEWER = "viewer"  # shows any topics, so none is missing


def examine(cell: Cell) -> Iterator[Finding]:
    """Yield all findings of a cell, each once; the quick ones first."""
    known: set[str] = set()
    for found in (*check_files(cell), *check_model(cell), *wiring(cell)):
        if not any(found.what.startswith(what) for what in known):  # a service may find the same
            known.add(found.what)
            yield found


def wiring(cell: Cell) -> Iterator[Finding]:
    """Yield configurations that services refuse, a missing task, and keys that do not match."""
    found, complete = [], True
    if cell.task not in cell.services:
        yield error(f"task: {cell.task!r} is no service of the cell, so that a run never ends",
                    f"name one of {', '.join(cell.services)}")
    for entry in cell.services.values():
        try:
            each = wire_service(cell, entry)
        except ConfigError as problem:
            yield refusal(problem)
        except WiringFailed as problem:
            yield error(str(problem), "correct the service, or its parameters", refused=True)
        except ZencellError as problem:
            yield error(f"services.{entry.name}: {problem}", "correct it", refused=True)
        else:
            found.append(Keys(each.name, each.reads, each.writes, each.serves, each.calls, entry.kind == VIEWER))
            continue
        complete = False
    for finding in check_wiring(found):
        if complete or finding.severity == "error":  # keys of a refused service are unknown
            yield finding


PER_SERVICE = ("log", "counters", "param")  # first parts of keys that each service or the supervisor has


class Keys(NamedTuple):
    """Keys of a service in the cell."""

    service: str
    reads: Collection[str]
    writes: Collection[str]
    serves: Collection[str]
    calls: Collection[str]
    reads_any: bool = False  # a viewer, whose unwritten keys are no problem


def check_wiring(services: Sequence[Keys]) -> Iterator[Finding]:
    """Yield keys with two owners, and keys that are read or called but not written or served."""
    owners: dict[str, str] = {}
    reported: set[tuple[str, str]] = set()
    for each in services:
        for key in sorted({*each.writes, *each.serves} - {*SHARED}):
            first = owners.setdefault(key, each.service)
            if first != each.service and (first, each.service) not in reported:
                reported.add((first, each.service))
                said = ownership.refusal(Owner(key, key, each.service, each.service), Owner(key, key, first, first))
                what, _, remedy = said.partition(": ")
                yield error(f"services.{each.service}: {what}", remedy, refused=True)
    served = {key for each in services for key in each.serves}
    for each in services:
        if each.reads_any:
            continue
        for verb, done, keys in (("reads", "writes", {*each.reads} - {*owners, *SHARED}),
                                 ("calls", "serves", {*each.calls} - served)):
            for key in sorted(key for key in keys if key.partition("/")[0] not in PER_SERVICE):
                near = get_close_matches(key, owners, n=1)
                remedy = f"add the service that {done} it, or rename it with topics of services.{each.service}"
                yield warning(f"services.{each.service}: {verb} {key}, which no service of the cell {done}",
                              remedy + (f" (is it {near[0]}?)" if near else ""))
