"""Who writes and who serves which key: in the cells that are up, else in those of the configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from common.topics import Request, Topic
    from common.transport.bus import Bus
    from common.transport.ownership import Owner

    Carried = Topic[Any] | Request[Any, Any]
    Found = tuple[str, Carried | None, str]  # key, what it carries, service

EVERYONE, SUPERVISOR = "everyone", "supervisor"


@dataclass
class Known:
    """A key: what it carries, where that is known, and which services write or serve it."""

    key: str
    topic: Carried | None
    services: list[str] = field(default_factory=list)

    @property
    def writer(self) -> str:
        """The services in one text."""
        return ", ".join(self.services)


def known_keys(cell: str | None, domain: str | None, connect: str | None) -> dict[str, Known]:
    """Every key, those of the platform and its applications first, and by whom it is written or served.

    Args:
        cell: name of the one that is asked for, or path of its file; all that are up if not given, else all of
            config/cells.
        domain: where, as given to `--domain`.
        connect: where, as given to `--connect`.
    """
    from common.application import all_topics
    from common.topics import COUNTERS, LOG, PARAMETERS, SUPERVISOR_STATUS, general_key

    shared = {LOG.key: EVERYONE, COUNTERS.key: EVERYONE, PARAMETERS.key: EVERYONE, SUPERVISOR_STATUS.key: SUPERVISOR}
    known = {key: Known(key, topic, [shared[key]] if key in shared else []) for key, topic in all_topics().items()}
    for key, topic, service in _live(cell, domain, connect) or _of_files(cell):
        if general_key(key) == key:
            services = known.setdefault(key, Known(key, topic)).services
            if service not in services:
                services.append(service)
    return known


def _live(cell: str | None, domain: str | None, connect: str | None) -> list[Found]:
    from cli.inspection import inspect
    from common.client.hearing import topic_of_owner
    from common.client.joining import LOOK_TIMEOUT, somebody_listens
    from common.transport.endpoint import endpoint_of
    from common.transport.keys import owns_key
    from common.transport.ownership import Owner

    if not somebody_listens(endpoint_of(domain, connect)):
        return []

    async def visit(bus: Bus) -> list[Owner]:
        return [Owner.of(token) for token in await bus.raw_tokens(owns_key(cell or "*"), LOOK_TIMEOUT)]

    found = inspect(visit, any_cell=True, domain=domain, connect=connect)
    return [(owner.key, topic_of_owner(owner), owner.service) for owner in found]


def _of_files(cell: str | None) -> list[Found]:
    from common.config import load_cell, names_of
    from common.graph.wired import Unwired, wired

    found: list[Found] = []
    for name in [cell] if cell else names_of("cells"):
        loaded = load_cell(name)
        for entry in loaded.services.values():
            try:
                wires = wired(loaded, entry)
            except Unwired:  # a service of a person's own, which `node info` tells about
                continue
            found += [(key, wires.topics[key], entry.name) for key in (*wires.writes, *wires.serves)]
    return found
