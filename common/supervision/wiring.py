"""What services read, write, serve and call, found by running each against a recorder instead of a cell."""

from __future__ import annotations

import asyncio
import importlib
import sys
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from typing import Any, TypeVar

from common.application import all_topics
from common.clock import Clock
from common.config import Cell, Parameters, Scenery, ServiceEntry, World, located, service_config
from common.errors import ConfigError, ZencellError
from common.messages import Message
from common.supervision.launch import require_module
from common.topics import Request, Topic
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from common.transport.ownership import SHARED, Owner, refusal
from common.transport.reader import Reader
from common.transport.requests import Client
from common.transport.writer import Writer

KINEMATIC = "kinematic"  # needs no extra

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
C = TypeVar("C")
AnyTopic = Topic[Any] | Request[Any, Any]


@dataclass
class Wiring:
    """The topics that a service declares, without its log and counters, which every service writes."""

    reads: set[Topic[Any]] = field(default_factory=set)
    writes: set[Topic[Any]] = field(default_factory=set)
    serves: set[Request[Any, Any]] = field(default_factory=set)
    calls: set[Request[Any, Any]] = field(default_factory=set)

    @property
    def owns(self) -> set[AnyTopic]:
        """What it writes or serves and no other service of the cell may."""
        owned: set[AnyTopic] = {*self.writes, *self.serves}
        return {topic for topic in owned if topic.key not in SHARED}


def owned_in(wirings: Mapping[str, Wiring]) -> dict[str, tuple[AnyTopic, list[str]]]:
    """Return by key each topic that services of a cell own, and the owners; more than one owner is an error.

    Args:
        wirings: wiring of each service by its name.
    """
    found: dict[str, tuple[AnyTopic, list[str]]] = {}
    for service, wired in wirings.items():
        for topic in wired.owns:
            found.setdefault(topic.key, (topic, []))[1].append(service)
    return found


def require_one_owner(wirings: Mapping[str, Wiring]) -> None:
    """Check that no two services of a cell write or serve the same key.

    Raises:
        ConfigError: two do; names both and the remedy.
    """
    for topic, services in owned_in(wirings).values():
        if len(services) > 1:
            first, second, *_ = (Owner(topic.key, topic.key, service, service) for service in services)
            raise ConfigError(f"services.{second.service}", ..., refusal(second, first))


class Recorder(Bus):
    """A bus on a network of its own that records declarations and never gets past `acquire_keys`."""

    def __init__(self, service: str = "recorded", topics: Mapping[str, str] | None = None) -> None:
        super().__init__(LocalNetwork().session(), service=service, cell="recorded", clock=Clock(), topics=topics)
        self.wiring = Wiring()

    def reader(self, topic: Topic[M], *, size: int = 1000, listening: bool = True) -> Reader[M]:
        """Record a topic that is read."""
        self.wiring.reads.add(self._in_cell(topic))
        return super().reader(topic, size=size, listening=listening)

    def writer(self, topic: Topic[M]) -> Writer[M]:
        """Record a topic that is written."""
        self.wiring.writes.add(self._in_cell(topic))
        return super().writer(topic)

    def serve(self, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]], **how: Any) -> None:
        """Record a request that is served."""
        self.wiring.serves.add(self._in_cell(topic))
        super().serve(topic, handler, **how)

    def client(self, topic: Request[Q, A]) -> Client[Q, A]:
        """Record a request that is called."""
        self.wiring.calls.add(self._in_cell(topic))
        return super().client(topic)

    async def acquire_keys(self) -> None:
        """Signal that all is declared, then wait to be cancelled; `ready` waits here too."""
        self._remapping.require_used(self.service)
        self.ready_event.set()
        await asyncio.get_running_loop().create_future()


async def wiring(
    run: Callable[[Bus, C], Coroutine[Any, Any, None]], config: C, *, service: str = "recorded", timeout: float = 30.0,
    topics: Mapping[str, str] | None = None,
) -> Wiring:
    """Return what `run` declares before it reports ready, with its keys as in the cell.

    Args:
        run: main function of the service.
        config: its parameters.
        service: its name in the cell.
        timeout: [s] until it has to be ready.
        topics: keys of the cell by the names that the service uses for them.

    Raises:
        RuntimeError: it ended, or `timeout` passed, before it was ready. Its own exceptions are passed on.
    """
    recorder = Recorder(service, topics)
    task = asyncio.create_task(recorder.run(run(recorder, _without_simulator(config))))
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


def _without_simulator(config: C) -> C:
    """Return the configuration with the built-in simulator and no generator: topics depend on neither."""
    if not isinstance(config, Parameters):
        return config
    plain: dict[str, object] = {"simulator": KINEMATIC}
    return config.model_copy(update={
        name: section.model_copy(update=plain | ({"generator": None} if isinstance(section, World) else {}))
        for name, section in config if isinstance(section, Scenery)})


async def wiring_of(cell: Cell, entry: ServiceEntry) -> Wiring:
    """Return what a service of the cell declares with its configuration there.

    Raises:
        RuntimeError: see `wiring`.
        ConfigError: the configuration is not valid.
    """
    module = importlib.import_module(entry.module)
    config = service_config(cell, entry.name, module.Config)
    return await wiring(module.run, config, service=entry.name, topics=entry.topics)


class WiringFailed(ZencellError):
    """A service failed before it had declared its topics."""

    exit_code = 1

    def __init__(self, service: str, error: BaseException) -> None:
        super().__init__(f"services.{service}: failed before it declared its topics: {error!r}")
        self.service = service


@dataclass
class ServiceWiring:
    """One service with the keys of its topics, for programs that show or compare them."""

    name: str
    doc: str
    config: Parameters | None = None
    reads: list[str] = field(default_factory=list)
    writes: list[str] = field(default_factory=list)
    serves: list[str] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    topics: dict[str, AnyTopic] = field(default_factory=dict)  # all of these, by key


def load_service(cell: Cell, entry: ServiceEntry) -> tuple[Any, Parameters]:
    """Return the module of a service and its configuration in the cell.

    Raises:
        ConfigError: its parameters or its module are not valid.
        WiringFailed: the module cannot be imported.
    """
    require_module(entry.name, entry)
    try:
        with redirect_stdout(sys.stderr):  # stdout carries the output of the command
            module = importlib.import_module(entry.module)
        kind: type[Parameters] = module.Config
    except Exception as error:  # a user's module may raise anything
        raise WiringFailed(entry.name, error) from error
    return module, service_config(cell, entry.name, kind)


def wire_service(cell: Cell, entry: ServiceEntry) -> ServiceWiring:
    """Run one service of a cell until it would be ready, on a network of its own, and return its keys.

    Raises:
        ConfigError: its parameters or its module are not valid.
        WiringFailed: it failed before it was ready.
    """
    module, config = load_service(cell, entry)
    # The same service may run now: its recorded copy must not bind the same port.
    unbound = config.model_copy(update={"port": 0}) if "port" in type(config).model_fields else config
    try:
        with redirect_stdout(sys.stderr):  # stdout carries the output of the command
            found = asyncio.run(wiring(module.run, unbound, service=entry.name, topics=entry.topics))
    except ZencellError as error:
        raise located(error, config, entry.name) from None
    except Exception as error:
        raise WiringFailed(entry.name, error) from error
    doc = (module.__doc__ or "").strip().partition("\n")[0]
    sides = ([topic for topic in side if not topic.signed]  # signed topics: every service has them
             for side in (found.reads, found.writes, found.serves, found.calls))
    reads, writes, serves, calls = (_in_order(side) for side in sides)
    every: set[AnyTopic] = {*found.reads, *found.writes, *found.serves, *found.calls}
    return ServiceWiring(entry.name, doc, config, reads, writes, serves, calls, {topic.key: topic for topic in every})


def wire_services(cell: Cell, on_failure: Callable[[WiringFailed], None]) -> list[ServiceWiring]:
    """Return the services of a cell in start order; one that fails has no keys, and is reported.

    Raises:
        ConfigError: the parameters of a service or its module are not valid.
    """
    found = []
    for entry in cell.services.values():
        try:
            found.append(wire_service(cell, entry))
        except WiringFailed as error:
            on_failure(error)
            found.append(ServiceWiring(entry.name, ""))
    return found


def _in_order(side: list[Any]) -> list[str]:
    """Return keys in the order of common/topics.py, then the others sorted."""
    known = list(all_topics())
    keys = {topic.key for topic in side}
    return [key for key in known if key in keys] + sorted(keys.difference(known))
