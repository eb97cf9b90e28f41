"""Who writes, reads, serves and asks what in a cell: keys with two owners, and with none."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from difflib import get_close_matches
from typing import NamedTuple

from common.transport.ownership import SHARED, Owner, refusal
from tools.check.finding import Finding, error, warning

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
                said = refusal(Owner(key, key, each.service, each.service), Owner(key, key, first, first))
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
