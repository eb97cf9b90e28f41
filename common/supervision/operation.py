"""A cell from bring-up to shutdown: the supervisor, its place on the network, and the signals that end it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from common import topics
from common.config import Cell
from common.errors import ConfigError, DecodeError, NoRouter, ZencellError
from common.messages import Notice, ServiceStatus, SupervisorStatus
from common.supervision.interrupts import Interrupts
from common.supervision.launch import Launch
from common.supervision.liveness_watchdog import PERIOD, Elsewhere, LivenessWatchdog
from common.supervision.supervisor import Supervisor
from common.time_source import monotonic
from common.transport.credentials import SUPERVISOR, CertificateMonitor
from common.transport.session import alive_key

if TYPE_CHECKING:
    from common.transport.bus import Bus

T = TypeVar("T")

NAME = "supervisor"
CONNECT_TIMEOUT = 5.0  # [s] to reach somebody else's router
LOOK_TIMEOUT = 1.0  # [s] to hear who is up there
SECRET = "token"  # in the path of an override: is not told
NOTICE_PERIOD = 60.0  # [s] between looks at certificates
LATE_PERIOD = 2.0  # [s] between looks at who is not ready yet: by then the token of one that was killed has gone
STATUS_PERIOD = 0.25  # [s] between looks at the connection to the router

log = logging.getLogger(NAME)


class Interrupted(ZencellError):
    """A signal asked for the end."""

    exit_code = 130

    def __init__(self) -> None:
        super().__init__("interrupted")


async def operate(
    cell: Cell, launch: Launch, supervisor: Supervisor, interrupts: Interrupts, work: Callable[[Bus], Awaitable[T]],
    prepare: Callable[[Bus], None] = lambda bus: None,
) -> T:
    """Bring the cell up, do the work, and leave no process behind, however it ends.

    Args:
        cell: the resolved cell.
        launch: how the cell was asked for.
        supervisor: of its processes; they have begun.
        interrupts: already installed.
        work: is done when all services are ready; cancelled by a signal.
        prepare: is called with the bus as soon as there is one, before the services are ready.

    Returns:
        What the work returns.

    Raises:
        ConfigError, BadConfiguration: bad input.
        StartFailed: the cell did not come up.
        Interrupted: by a signal.
    """
    from common.transport.endpoint import endpoint_of

    endpoint = endpoint_of(None if launch.connect else launch.domain, launch.connect)
    working = asyncio.create_task(_work(cell, launch, endpoint, supervisor, work, prepare))
    stopped = asyncio.create_task(interrupts.stop.wait())
    try:
        anything: set[asyncio.Future[Any]] = {working, stopped, supervisor.failure}
        await asyncio.wait(anything, return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            working.cancel()
            await asyncio.wait({working})
        if supervisor.failure.done():
            supervisor.failure.result()
        if working.cancelled():
            raise Interrupted
        return working.result()
    finally:
        stopped.cancel()
        await supervisor.stop(interrupts.hurry)


async def _work(
    cell: Cell, launch: Launch, endpoint: str, supervisor: Supervisor, work: Callable[[Bus], Awaitable[T]],
    prepare: Callable[[Bus], None],
) -> T:
    from common.process.log import BusLog
    from common.supervision.plain_keys import keep_plain_keys
    from common.transport.zenoh_session import connect

    timeout = CONNECT_TIMEOUT if launch.connect else None  # our own router is watched by the supervisor
    connecting = connect(cell=cell.name, service=NAME, endpoint=endpoint, clock=launch.clock, timeout=timeout,
                         identity=SUPERVISOR, near=launch.near)
    bus = await supervisor.reach_router(connecting.__aenter__())
    to_topic = BusLog(bus)
    log.addHandler(to_topic)
    try:
        if launch.connect:
            await _require_unused(bus, endpoint, {entry.name for entry in cell.services.values()})
        prepare(bus)
        here = Elsewhere(socket.gethostname(), [service.name for service in supervisor.statuses])
        helping = beside(keep_plain_keys(bus, here), ask_for_the_late(cell.name, endpoint, supervisor, launch.near))
        return await beside(helping, supervise(bus, cell, launch, supervisor, work))
    finally:
        log.removeHandler(to_topic)
        await connecting.__aexit__(None, None, None)


async def supervise(
    bus: Bus, cell: Cell, launch: Launch, supervisor: Supervisor, work: Callable[[Bus], Awaitable[T]],
    host: str | None = None,
) -> T:
    """What the work returns, which is done when all services are ready; meanwhile tell of them, and kill the frozen.

    Args:
        bus: of the supervisor.
        cell: the resolved cell.
        launch: how the cell was asked for.
        supervisor: of its processes; they have begun.
        work: is done when all services are ready.
        host: what this host is called; its own name by default.
    """
    bus.alive.on_change(supervisor.mark_alive)
    watching = beside(_kill_frozen(bus, cell, supervisor), _bring_up_and_work(bus, supervisor, work))
    elsewhere = Elsewhere(host or socket.gethostname(), [service.name for service in supervisor.statuses])
    telling = beside(_hear_elsewhere(bus, elsewhere), _publish(bus, cell, launch, supervisor, elsewhere))
    return await beside(telling, watching)


async def _bring_up_and_work(bus: Bus, supervisor: Supervisor, work: Callable[[Bus], Awaitable[T]]) -> T:
    await bus.alive.known()  # a token that comes up while its watch begins may not be told of
    await supervisor.admit_all()
    await bus.ready()
    return await work(bus)


async def ask_for_the_late(cell: str, endpoint: str, supervisor: Supervisor, near: Sequence[str] | None = None) -> None:
    """Mark services as ready whose readiness tokens the router has and the network did not tell of.

    Zenoh was seen to leave one out that came up while the watch of the tokens began, once in some hundred starts. A
    question of the same session is answered from what its watch was told, so that one of its own asks.

    Args:
        cell: its name.
        endpoint: of the router.
        supervisor: of the processes.
        near: endpoints of the same router to be tried first.
    """
    from common.transport.zenoh_session import connect

    late: set[str] = set()
    while True:
        await asyncio.sleep(LATE_PERIOD)
        before, late = late, set(supervisor.starting)
        if not before & late:
            continue
        with contextlib.suppress(NoRouter):
            asking = connect(cell=cell, service=NAME, endpoint=endpoint, identity=SUPERVISOR, near=near)
            async with asking as bus:
                tokens = await bus.raw_tokens(alive_key(cell), LOOK_TIMEOUT)
            for name in {token.rpartition("/")[2] for token in tokens} & before & set(supervisor.starting):
                log.warning("%s is ready, which the network did not tell; the router was asked", name)
                supervisor.mark_alive(name, alive=True)


async def _require_unused(bus: Bus, endpoint: str, names: set[str]) -> None:
    """Return when no other supervisor behind somebody else's router has one of these services.

    Raises:
        ConfigError: one has.
    """
    from common.transport.codec import decode

    for sample in await bus.raw_get(f"{bus.cell}/{topics.SUPERVISOR_STATUS.key}", LOOK_TIMEOUT):
        try:
            others = {service.name for service in decode(SupervisorStatus, sample.payload).services}
        except DecodeError:
            others = names  # of another version: its services cannot be told apart from ours
        if names & others:
            raise ConfigError("--connect", endpoint, f"is where a cell named {bus.cell} is up already")


async def _hear_elsewhere(bus: Bus, elsewhere: Elsewhere) -> None:
    async for status in bus.reader(topics.SUPERVISOR_STATUS):
        elsewhere.hear(status)


async def _publish(bus: Bus, cell: Cell, launch: Launch, supervisor: Supervisor, elsewhere: Elsewhere) -> None:
    """Say on supervisor/status whenever something has changed; take note of a router that is back."""
    out = bus.writer(topics.SUPERVISOR_STATUS)
    told: tuple[list[ServiceStatus], list[Notice]] = [], []
    ends, notices, looked = CertificateMonitor(), list[Notice](), -NOTICE_PERIOD
    while True:
        supervisor.mark_connected(bus.connected)
        if monotonic() - looked >= NOTICE_PERIOD:
            looked = monotonic()
            notices = [Notice(urgent=urgent, message=line, host=elsewhere.host) for urgent, line in ends.warnings()]
        away = elsewhere.statuses(bus.alive.names), [*notices, *elsewhere.notices]
        if supervisor.changed.is_set() or away != told:
            supervisor.changed.clear()
            told = away
            out.put(SupervisorStatus(
                header=bus.header(), cell=bus.cell, host=elsewhere.host,
                services=[*elsewhere.ours(supervisor.statuses), *away[0]],
                speed=bus.clock.speed, epoch=bus.clock.epoch_ns, booted=bus.clock.booted_ns,
                seed=cell.run.seed, world=launch.world or "",
                notices=away[1],
                overrides=[text for text in launch.overrides if SECRET not in text.partition("=")[0]],
            ))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_PERIOD):  # wait_for can swallow a cancellation before Python 3.12
                await supervisor.changed.wait()


async def _kill_frozen(bus: Bus, cell: Cell, supervisor: Supervisor) -> None:
    """Kill processes that are there and yet do nothing: they are started again."""
    silence = LivenessWatchdog(cell.watchdogs)

    async def listen() -> None:
        # which they tell each second while somebody listens
        async for counters in bus.reader(replace(topics.COUNTERS, plain=False)):
            silence.heard(counters.service)

    async def look() -> None:
        while True:
            await asyncio.sleep(PERIOD)
            now, kept = monotonic(), supervisor.kept
            for verdict in silence.look(now, bus.connected, kept, supervisor.stopped, supervisor.waited):
                supervisor.kill(verdict.name, verdict.reason)

    await beside(listen(), look())


async def beside(background: Coroutine[Any, Any, None], main: Coroutine[Any, Any, T]) -> T:
    """The result of `main`, while `background` runs until then; what either raises is raised."""
    tasks = asyncio.create_task(background), asyncio.create_task(main)
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if tasks[0].done():
            tasks[0].result()
        return await tasks[1]
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
