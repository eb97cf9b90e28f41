"""Keys by name, and who writes and serves each: in the cells that are up, else in those of the configuration."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import Any

from common.application import all_topics, find_topic
from common.client.foreign import require_key
from common.client.joining import LOOK_TIMEOUT, is_listening, joined
from common.client.subscriptions import Carried, topic_of_owner
from common.config import load_cell, names_of
from common.errors import UnknownName
from common.topics import COUNTERS, LOG, PARAMETERS, SUPERVISOR_STATUS, Topic, general_key
from common.transport.endpoint import endpoint_of
from common.transport.ownership import Owner
from common.transport.session import owns_key

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
    shared = {LOG.key: EVERYONE, COUNTERS.key: EVERYONE, PARAMETERS.key: EVERYONE, SUPERVISOR_STATUS.key: SUPERVISOR}
    known = {key: Known(key, topic, [shared[key]] if key in shared else []) for key, topic in all_topics().items()}
    for key, topic, service in asyncio.run(_live(cell, domain, connect)) or _of_files(cell):
        if general_key(key) == key:
            services = known.setdefault(key, Known(key, topic)).services
            if service not in services:
                services.append(service)
    return known


async def _live(cell: str | None, domain: str | None, connect: str | None) -> list[Found]:
    if not await asyncio.to_thread(is_listening, endpoint_of(domain, connect)):
        return []
    async with joined(any_cell=True, domain=domain, connect=connect) as bus:
        found = [Owner.of(token) for token in await bus.raw_tokens(owns_key(cell or "*"), LOOK_TIMEOUT)]
    return [(owner.key, topic_of_owner(owner), owner.service) for owner in found]


def _of_files(cell: str | None) -> list[Found]:
    from common.supervision.wiring import WiringFailed, wire_service

    found: list[Found] = []
    for name in [cell] if cell else names_of("cells"):
        loaded = load_cell(name)
        for entry in loaded.services.values():
            try:
                wires = wire_service(loaded, entry)
            except WiringFailed:  # a service of a person's own, which `node info` tells about
                continue
            found += [(key, wires.topics[key], entry.name) for key in (*wires.writes, *wires.serves)]
    return found


def topic_of(key: str) -> Carried:
    """The topic or request of a key.

    Raises:
        UnknownName: with the keys that there are.
    """
    topic = find_topic(key)
    if topic is None:
        raise UnknownName("key", key, all_topics())
    return topic


def published(key: str) -> Topic[Any]:
    """The topic of a key that is published.

    Raises:
        UnknownName: with the keys that are.
    """
    topic = topic_of(key)
    if not isinstance(topic, Topic):
        raise UnknownName("published key", key, [k for k, t in all_topics().items() if isinstance(t, Topic)])
    return topic


def published_or_foreign(key: str) -> Topic[Any] | None:
    """The topic of a key that is published; None for a key of somebody else's.

    Raises:
        UnknownName: with the keys that are published, for one that is requested, and for what is no key.
    """
    if find_topic(key):
        return published(key)
    require_key(key)
    return None
