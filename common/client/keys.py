"""Keys of topics and requests: which exist, which services write or serve them, and messages of unknown keys.

An unknown key is one that no Topic of the project describes, such as those of custom services; its messages are shown
as the msgpack they are.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Iterable
from contextlib import aclosing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from common.application import all_topics, find_topic
from common.client.joining import TOKENS_TIMEOUT, is_listening, joined
from common.client.subscriptions import AnyTopic, topic_of_owner
from common.config import load_cell, names_of
from common.errors import UnknownName
from common.remapping import is_key
from common.topics import COUNTERS, LOG, PARAMETERS, SUPERVISOR_STATUS, Topic, general_key
from common.transport.endpoint import endpoint_of
from common.transport.ownership import Owner
from common.transport.session import owns_key

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.session import RawSample

Found = tuple[str, AnyTopic | None, str]  # key, topic if known, service
EVERYONE, SUPERVISOR = "everyone", "supervisor"
SILENCE = 2.0  # [s] without a message after which an unknown key counts as a typing error


@dataclass
class Known:
    """A key: its topic, if known, and the services that write or serve it."""

    key: str
    topic: AnyTopic | None
    services: list[str] = field(default_factory=list)

    @property
    def writer(self) -> str:
        """The services, separated by commas."""
        return ", ".join(self.services)


def known_keys(cell: str | None, domain: str | None, connect: str | None) -> dict[str, Known]:
    """Return every key with its writers, those of the platform and its applications first.

    Args:
        cell: name, or path of its file; default: all running cells, else all of config/cells.
        domain: of the router, as for `--domain`.
        connect: endpoint of the router, as for `--connect`.
    """
    shared = {LOG.key: EVERYONE, COUNTERS.key: EVERYONE, PARAMETERS.key: EVERYONE, SUPERVISOR_STATUS.key: SUPERVISOR}
    known = {key: Known(key, topic, [shared[key]] if key in shared else []) for key, topic in all_topics().items()}
    for key, topic, service in asyncio.run(_running(cell, domain, connect)) or _configured(cell):
        if general_key(key) == key:
            services = known.setdefault(key, Known(key, topic)).services
            if service not in services:
                services.append(service)
    return known


async def _running(cell: str | None, domain: str | None, connect: str | None) -> list[Found]:
    if not await asyncio.to_thread(is_listening, endpoint_of(domain, connect)):
        return []
    async with joined(any_cell=True, domain=domain, connect=connect) as bus:
        found = [Owner.of(token) for token in await bus.raw_tokens(owns_key(cell or "*"), TOKENS_TIMEOUT)]
    return [(owner.key, topic_of_owner(owner), owner.service) for owner in found]


def _configured(cell: str | None) -> list[Found]:
    from common.supervision.wiring import WiringFailed, wire_service

    found: list[Found] = []
    for name in [cell] if cell else names_of("cells"):
        loaded = load_cell(name)
        for entry in loaded.services.values():
            try:
                wired = wire_service(loaded, entry)
            except WiringFailed:  # a custom service; `node info` reports its error
                continue
            found += [(key, wired.topics[key], entry.name) for key in (*wired.writes, *wired.serves)]
    return found


def topic_of(key: str) -> AnyTopic:
    """Return the topic or request of a key.

    Raises:
        UnknownName: there is none; with the choices.
    """
    topic = find_topic(key)
    if topic is None:
        raise UnknownName("key", key, all_topics())
    return topic


def published_topic(key: str) -> Topic[Any] | None:
    """Return the topic of a published key, or None for an unknown key.

    Raises:
        UnknownName: the key is a request, or not valid; with the published keys.
    """
    topic = find_topic(key)
    if topic is None:
        require_key(key)
        return None
    if not isinstance(topic, Topic):
        raise UnknownName("published key", key, published_keys())
    return topic


def published_keys() -> list[str]:
    """Return all keys that are published."""
    return [key for key, topic in all_topics().items() if isinstance(topic, Topic)]


def require_key(key: str, *, several: bool = True) -> None:
    """Check that a key is valid; with `several` it may contain the wildcards * and **.

    Raises:
        UnknownName: it is not, for example because of a leading slash; with the published keys.
    """
    parts = ("x" if several and part in ("*", "**") else part for part in key.split("/"))
    if not is_key("/".join(parts)):
        raise UnknownName("key", key, published_keys())


class SilentKey(UnknownName):
    """An unknown key without messages."""

    def __init__(self, key: str, why: str) -> None:
        super().__init__("key", key, published_keys())
        self.args = (f"{self}; {why}",)


async def raw_samples(bus: Bus, key: str) -> AsyncGenerator[RawSample, None]:
    """Yield samples of a key of the cell without repetitions, first its current value if it is a state.

    Raises:
        SilentKey: no message arrived within `SILENCE`.
    """
    from common.transport.reader import SequenceFilter

    full = f"{bus.cell}/{key}"
    newness = SequenceFilter()
    arriving = bus.raw_reader(full)
    following = asyncio.ensure_future(anext(arriving))
    try:
        latched = await bus.raw_get(full, SILENCE)
        for sample in latched:
            if newness.is_new_payload(sample.attachment):
                yield sample
        if not latched:
            await asyncio.wait({following}, timeout=SILENCE)
            if not following.done():
                raise SilentKey(key, f"no message on {full} within {SILENCE:g} s")
        while True:
            sample = await following
            following = asyncio.ensure_future(anext(arriving))
            if newness.is_new_payload(sample.attachment):
                yield sample
    finally:
        following.cancel()  # which closes its generator
        await asyncio.wait({following})


async def require_messages(bus: Bus, key: str) -> None:
    """Return when a message arrives on a key.

    Raises:
        SilentKey: no message arrived within `SILENCE`.
    """
    async with aclosing(raw_samples(bus, key)) as samples:
        await anext(samples)


async def writers_of(bus: Bus, keys: Iterable[str]) -> list[tuple[str, str]]:
    """Return the services of the cell that write some of these keys, each with the key."""
    owners = await bus.owners()
    return [(owner.service, key) for key in keys for owner in owners if owner.key == key]
