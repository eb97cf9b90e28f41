"""What a service reads, writes, serves and calls, found by running it against a recorder."""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from common.clock import Clock
from common.config import Cell, ServiceEntry, service_config
from common.errors import ConfigError
from common.messages import Message
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from common.transport.ownership import SHARED, Owner, refusal
from common.transport.reader import Reader
from common.transport.requests import Client
from common.transport.writer import Writer

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
C = TypeVar("C")


@dataclass
class Wiring:
    """The topics that a service has to do with; what every service writes, its log and counters, is left out."""

    reads: set[Topic[Any]] = field(default_factory=set)
    writes: set[Topic[Any]] = field(default_factory=set)
    serves: set[Request[Any, Any]] = field(default_factory=set)
    calls: set[Request[Any, Any]] = field(default_factory=set)


    @property
    def owns(self) -> set[Topic[Any] | Request[Any, Any]]:
        """What it writes or serves, which in a cell nobody else does."""
        owned: set[Topic[Any] | Request[Any, Any]] = {*self.writes, *self.serves}
        return {topic for topic in owned if topic.key not in SHARED}


def owned_in(wirings: Mapping[str, Wiring]) -> dict[str, tuple[Topic[Any] | Request[Any, Any], list[str]]]:
    """By key what the services of a cell write or serve, and who does: more than one is one too many.

    Args:
        wirings: of its services, by their names.
    """
    found: dict[str, tuple[Topic[Any] | Request[Any, Any], list[str]]] = {}
    for service, wired in wirings.items():
        for topic in wired.owns:
            found.setdefault(topic.key, (topic, []))[1].append(service)
    return found


def require_one_owner(wirings: Mapping[str, Wiring]) -> None:
    """Return when no two services of a cell write or serve one key.

    Raises:
        ConfigError: two do; names both and what helps.
    """
    for topic, services in owned_in(wirings).values():
        if len(services) > 1:
            first, second, *_ = (Owner(topic.key, topic.key, service, service) for service in services)
            raise ConfigError(f"services.{second.service}", ..., refusal(second, first))


class Recorder(Bus):
    """A bus on a network of its own that records declarations, and never gets past `acquire_keys` or `ready`."""

    def __init__(self, service: str = "recorded", topics: Mapping[str, str] | None = None) -> None:
        super().__init__(LocalNetwork().session(), service=service, cell="recorded", clock=Clock(), topics=topics)
        self.wiring = Wiring()

    def reader(self, topic: Topic[M], *, size: int = 1000, listening: bool = True) -> Reader[M]:
        """A reader that gets nothing."""
        self.wiring.reads.add(self._in_cell(topic))
        return super().reader(topic, size=size, listening=listening)

    def writer(self, topic: Topic[M]) -> Writer[M]:
        """A writer that nobody listens to."""
        self.wiring.writes.add(self._in_cell(topic))
        return super().writer(topic)

    def serve(self, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]], **how: Any) -> None:
        """Note what is served."""
        self.wiring.serves.add(self._in_cell(topic))
        super().serve(topic, handler, **how)

    def client(self, topic: Request[Q, A]) -> Client[Q, A]:
        """A client whose calls nobody answers."""
        self.wiring.calls.add(self._in_cell(topic))
        return super().client(topic)

    async def acquire_keys(self) -> None:
        """Wait for cancellation: everything is declared. What a service loads or opens after this is not needed."""
        self._remapping.require_used(self.service)
        self.ready_event.set()
        await asyncio.get_running_loop().create_future()


async def wiring(
    run: Callable[[Bus, C], Coroutine[Any, Any, None]], config: C, *, service: str = "recorded", timeout: float = 30.0,
    topics: Mapping[str, str] | None = None,
) -> Wiring:
    """What `run` declares, under a service's name, before it says that it is ready, with its keys as in the cell.

    Raises:
        RuntimeError: it ended, or `timeout` seconds passed, before it was ready. What it raises itself is raised.
    """
    recorder = Recorder(service, topics)
    task = asyncio.create_task(recorder.run(run(recorder, config)))
    is_ready = asyncio.create_task(recorder.ready_event.wait())
    try:
        await asyncio.wait({task, is_ready}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            await task
        if not recorder.ready_event.is_set():
            raise RuntimeError(f"{'it ended' if task.done() else f'{timeout:g} s passed'} before ready()")
    finally:
        is_ready.cancel()
        task.cancel()
        await asyncio.wait({task})
        await recorder.close()
    return recorder.wiring


async def wiring_of(cell: Cell, entry: ServiceEntry) -> Wiring:
    """What a service of the cell declares with the configuration that it has there.

    Raises:
        RuntimeError: as `wiring`.
        ConfigError: it cannot be configured so.
    """
    module = importlib.import_module(entry.module)
    config = service_config(cell, entry.name, module.Config)
    return await wiring(module.run, config, service=entry.name, topics=entry.topics)
