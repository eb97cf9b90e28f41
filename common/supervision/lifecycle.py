"""A cell from start to shutdown: run its processes, publish their status, kill frozen ones, react to signals.

The supervisor also copies log lines and counters to the plain keys `log` and `counters`, their names before each
service had its own, for plain Zenoh clients and one version more. Our readers skip these copies
(`common/transport/copies.py`). A message under the key of another service is not copied.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from common import topics
from common.config import Cell
from common.errors import ConfigError, DecodeError, NoRouter, ZencellError
from common.messages import Notice, ServiceStatus, SupervisorStatus
from common.supervision.launch import Launch
from common.supervision.liveness_watchdog import PERIOD, LivenessWatchdog, RemoteServices
from common.supervision.supervisor import Supervisor
from common.time_source import monotonic
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.codec import encode, encoding_of
from common.transport.credentials import SUPERVISOR, CertificateMonitor
from common.transport.session import alive_key
from common.transport.writer import COPY, plain_key

if TYPE_CHECKING:
    from common.transport.bus import Bus

T = TypeVar("T")

NAME = "supervisor"
CONNECT_TIMEOUT = 5.0  # [s] to reach a router that we did not start
QUERY_TIMEOUT = 1.0  # [s] for supervisors and tokens behind a router
SECRET = "token"  # overrides with this in their path are not published
NOTICE_PERIOD = 60.0  # [s] between checks of certificates
TOKEN_PERIOD = 2.0  # [s] between checks for missed tokens: by then the token of a killed process has gone
STATUS_PERIOD = 0.25  # [s] between checks of the connection to the router
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

log = logging.getLogger(NAME)


class Interrupts:
    """Counts signals that ask for the end: the first one stops, the second one kills."""

    def __init__(self) -> None:
        """Start before `install`, without signals."""
        self.stop = asyncio.Event()
        self.hurry = asyncio.Event()
        self.signal: int | None = None  # the first one

    def install(self) -> None:
        """Handle the signals from now on, on the running loop."""
        loop = asyncio.get_running_loop()
        for number in STOP_SIGNALS:
            loop.add_signal_handler(number, self._on_signal, number)

    def _on_signal(self, number: int) -> None:
        if self.stop.is_set():
            self.hurry.set()
        else:
            self.signal = number
            self.stop.set()


def interrupt_at_stdin_end() -> None:
    """Treat the end of standard input like Ctrl-C, so that this process ends with the program that started it."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(sys.stdin.fileno(), 4096):
                pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=watch, name="stdin", daemon=True).start()


class Interrupted(ZencellError):
    """A signal ended the cell."""

    exit_code = 130

    def __init__(self) -> None:
        super().__init__("interrupted")


async def run_cell(
    cell: Cell, launch: Launch, supervisor: Supervisor, interrupts: Interrupts, work: Callable[[Bus], Awaitable[T]],
    prepare: Callable[[Bus], None] = lambda bus: None,
) -> T:
    """Bring the cell up, do the work, and leave no process behind, however it ends.

    Args:
        cell: the resolved cell.
        launch: options of the launch.
        supervisor: of its processes, which are started.
        interrupts: already installed.
        work: is awaited when all services are ready; cancelled by a signal.
        prepare: called with the bus as soon as it exists, before the services are ready.

    Returns:
        The result of the work.

    Raises:
        ConfigError, BadConfiguration: bad input.
        StartFailed: the cell did not come up.
        Interrupted: by a signal.
    """
    from common.transport.endpoint import endpoint_of

    endpoint = endpoint_of(None if launch.connect else launch.domain, launch.connect)
    working = asyncio.create_task(_connect_and_work(cell, launch, endpoint, supervisor, work, prepare))
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


async def _connect_and_work(
    cell: Cell, launch: Launch, endpoint: str, supervisor: Supervisor, work: Callable[[Bus], Awaitable[T]],
    prepare: Callable[[Bus], None],
) -> T:
    from common.process.log import BusLog
    from common.supervision.lifecycle import copy_to_plain_keys
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
        remote = RemoteServices(socket.gethostname(), [service.name for service in supervisor.statuses])
        background = run_with_background(
            copy_to_plain_keys(bus, remote), recover_missed_tokens(cell.name, endpoint, supervisor, launch.near))
        return await run_with_background(background, supervise(bus, cell, launch, supervisor, work))
    finally:
        log.removeHandler(to_topic)
        await connecting.__aexit__(None, None, None)


async def supervise(
    bus: Bus, cell: Cell, launch: Launch, supervisor: Supervisor, work: Callable[[Bus], Awaitable[T]],
    host: str | None = None,
) -> T:
    """Return the result of the work, done when all services are ready; publish their status and kill frozen ones.

    Args:
        bus: of the supervisor.
        cell: the resolved cell.
        launch: options of the launch.
        supervisor: of its processes, which are started.
        work: is awaited when all services are ready.
        host: name of this host; the system's by default.
    """
    bus.alive.on_change(supervisor.mark_alive)
    working = run_with_background(kill_frozen(bus, cell, supervisor), _bring_up_and_work(bus, supervisor, work))
    remote = RemoteServices(host or socket.gethostname(), [service.name for service in supervisor.statuses])
    reporting = run_with_background(
        _follow_supervisors(bus, remote), publish_status(bus, cell, launch, supervisor, remote))
    return await run_with_background(reporting, working)


async def _bring_up_and_work(bus: Bus, supervisor: Supervisor, work: Callable[[Bus], Awaitable[T]]) -> T:
    await bus.alive.known()  # a token that appears while its watch starts may be missed
    await supervisor.admit_all()
    await bus.ready()
    return await work(bus)


async def recover_missed_tokens(
    cell: str, endpoint: str, supervisor: Supervisor, near: Sequence[str] | None = None, period: float = TOKEN_PERIOD,
) -> None:
    """Mark services as ready whose readiness tokens the router has and the subscription missed.

    About once in a hundred starts Zenoh misses a token that appears while the subscription to tokens starts. A query in
    the same session is answered from that subscription, so this uses a session of its own.

    Args:
        cell: its name.
        endpoint: of the router.
        supervisor: of the processes.
        near: endpoints of the same router to try first.
        period: [s] between two checks; a service that is starting in two of them is looked up.
    """
    from common.transport.zenoh_session import connect

    late: set[str] = set()
    while True:
        await asyncio.sleep(period)
        before, late = late, set(supervisor.starting)
        if not before & late:
            continue
        with contextlib.suppress(NoRouter):
            connecting = connect(cell=cell, service=NAME, endpoint=endpoint, identity=SUPERVISOR, near=near)
            async with connecting as bus:
                tokens = await bus.raw_tokens(alive_key(cell), QUERY_TIMEOUT)
            for name in {token.rpartition("/")[2] for token in tokens} & before & set(supervisor.starting):
                log.warning("%s is ready: the router has its token, which the subscription missed", name)
                supervisor.mark_alive(name, alive=True)


async def _require_unused(bus: Bus, endpoint: str, names: set[str]) -> None:
    """Check that no other supervisor behind a shared router runs one of these services.

    Raises:
        ConfigError: one does.
    """
    from common.transport.codec import decode

    for sample in await bus.raw_get(f"{bus.cell}/{topics.SUPERVISOR_STATUS.key}", QUERY_TIMEOUT):
        try:
            others = {service.name for service in decode(SupervisorStatus, sample.payload).services}
        except DecodeError:
            others = names  # of another version: assume the worst
        if names & others:
            raise ConfigError("--connect", endpoint, f"already has a running cell named {bus.cell}")


async def _follow_supervisors(bus: Bus, remote: RemoteServices) -> None:
    async for status in bus.reader(topics.SUPERVISOR_STATUS):
        remote.update(status)


async def publish_status(
    bus: Bus, cell: Cell, launch: Launch, supervisor: Supervisor, remote: RemoteServices,
    notice_period: float = NOTICE_PERIOD,
) -> None:
    """Publish supervisor/status after each change, and mark the router as ready while it is connected.

    Args:
        bus: of the supervisor.
        cell: the resolved cell.
        launch: options of the launch.
        supervisor: of its processes.
        remote: services of other hosts.
        notice_period: [s] between checks of certificates.
    """
    out = bus.writer(topics.SUPERVISOR_STATUS)
    published: tuple[list[ServiceStatus], list[Notice]] = [], []
    expiry, notices, checked = CertificateMonitor(), list[Notice](), -notice_period
    while True:
        supervisor.mark_connected(bus.connected)
        if monotonic() - checked >= notice_period:
            checked = monotonic()
            notices = [Notice(urgent=urgent, message=line, host=remote.host) for urgent, line in expiry.warnings()]
        now = remote.statuses(bus.alive.names), [*notices, *remote.notices]
        if supervisor.changed.is_set() or now != published:
            supervisor.changed.clear()
            published = now
            out.put(SupervisorStatus(
                header=bus.header(), cell=bus.cell, has_task=bool(cell.task), host=remote.host,
                services=[*remote.ours(supervisor.statuses), *now[0]],
                speed=bus.clock.speed, epoch=bus.clock.epoch_ns, booted=bus.clock.booted_ns,
                seed=cell.run.seed, world=launch.world or "",
                notices=now[1],
                overrides=[text for text in launch.overrides if SECRET not in text.partition("=")[0]],
            ))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_PERIOD):  # wait_for can swallow a cancellation before Python 3.12
                await supervisor.changed.wait()


async def kill_frozen(bus: Bus, cell: Cell, supervisor: Supervisor, period: float = PERIOD) -> None:
    """Kill processes that run and send nothing, checked each period [s]; the supervisor restarts them."""
    watchdog = LivenessWatchdog(cell.watchdogs)

    async def listen() -> None:
        # each service publishes its counters every second while they have a subscriber
        async for counters in bus.reader(replace(topics.COUNTERS, plain=False)):
            watchdog.seen(counters.service)

    async def check() -> None:
        while True:
            await asyncio.sleep(period)
            now, processes = monotonic(), supervisor.restartable
            for verdict in watchdog.check(now, bus.connected, processes, supervisor.stopped, supervisor.waited):
                supervisor.kill(verdict.name, verdict.reason)

    await run_with_background(listen(), check())


async def run_with_background(background: Coroutine[Any, Any, None], main: Coroutine[Any, Any, T]) -> T:
    """Return the result of `main` while `background` runs; an exception of either is raised."""
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


MATCH_PERIOD = 1.0  # [s] between checks for subscribers of a plain key


async def copy_to_plain_keys(bus: Bus, remote: RemoteServices) -> None:
    """Copy log lines and counters to their plain keys while those have subscribers.

    Args:
        bus: of the supervisor.
        remote: services whose messages another supervisor copies.
    """

    async def follow_supervisors() -> None:
        async for status in bus.reader(topics.SUPERVISOR_STATUS):
            remote.update(status)

    await asyncio.gather(follow_supervisors(), *(_copy(bus, topic, remote) for topic in (topics.LOG, topics.COUNTERS)))


async def _copy(bus: Bus, topic: Topic[Any], remote: RemoteServices) -> None:
    out = bus.raw_publisher(f"{bus.cell}/{plain_key(topic)}", encoding_of(topic.message), reliable=True)
    reader = bus.reader(replace(topic, plain=False), listening=False)
    while True:
        bus.listen(reader, out.matched)
        try:
            async with asyncio.timeout(MATCH_PERIOD):
                message = await reader.next()
        except TimeoutError:
            continue
        if remote.is_copied_here(message.service):
            out.put(encode(message), COPY)
