"""All findings of a cell, those among them that its services make when they are run until they would be ready."""

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

SHOWS = "viewer"  # a page shows whatever there is


def examine(cell: Cell) -> Iterator[Finding]:
    """All findings of a cell, each once; the quick ones first."""
    told: set[str] = set()
    for found in (*check_files(cell), *check_model(cell), *wiring(cell)):
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


EVERYBODY = ("log", "counters", "param")  # first parts of keys that each service has, or the supervisor


class Keys(NamedTuple):
    """What a service has to do with, as keys of the cell."""

    service: str
    reads: Collection[str]
    writes: Collection[str]
    serves: Collection[str]
    calls: Collection[str]
    shows: bool = False  # whatever there is, such as a page: it misses nothing


def check_wiring(services: Sequence[Keys]) -> Iterator[Finding]:
    """Two that own a key, and readers and callers of what nobody writes or serves."""
    owners: dict[str, str] = {}
    told: set[tuple[str, str]] = set()
    for each in services:
        for key in sorted({*each.writes, *each.serves} - {*SHARED}):
            first = owners.setdefault(key, each.service)
            if first != each.service and (first, each.service) not in told:
                told.add((first, each.service))
                said = ownership.refusal(Owner(key, key, each.service, each.service), Owner(key, key, first, first))
                what, _, remedy = said.partition(": ")
                yield error(f"services.{each.service}: {what}", remedy, refused=True)
    served = {key for each in services for key in each.serves}
    for each in services:
        if each.shows:
            continue
        for verb, done, keys in (("reads", "writes", {*each.reads} - {*owners, *SHARED}),
                                 ("asks", "serves", {*each.calls} - served)):
            for key in sorted(key for key in keys if key.partition("/")[0] not in EVERYBODY):
                near = get_close_matches(key, owners, n=1)
                remedy = f"add the service that {done} it, or rename it with topics of services.{each.service}"
                yield warning(f"services.{each.service}: {verb} {key}, which nobody in the cell {done}",
                              remedy + (f" (is it {near[0]}?)" if near else ""))
