"""Starts a cell's processes in order, restarts what dies, and leaves none behind."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

from common.config import Cell
from common.errors import ZencellError
from common.messages import ServiceStatus
from common.supervision.child import Backoff, Child, describe_exit
from common.supervision.launch import Launch
from common.time_source import monotonic
from common.transport.endpoint import remapped_small_keys
from common.transport.session import ROUTER

T = TypeVar("T")

START_TIMEOUT = 15.0  # [s] from being let through the gate to the readiness token
HEAD_START = 0.5  # [s] between SIGTERM to one service and to the one before it, when it does not end sooner
TERM_TIMEOUT = 5.0  # [s] from SIGTERM to SIGKILL
STOP_TIMEOUT = 6.5  # [s] after which every service that still runs is killed
SHOWN_LINES = 5  # last log lines in the error of a service that did not become ready
CONFIG_EXIT = 2  # a process that ends with this code was configured wrongly: starting it again will not help

log = logging.getLogger("supervisor")


class StartFailed(ZencellError):
    """The cell did not come up, and not because of a wrong configuration."""

    exit_code = 1


class BadConfiguration(ZencellError):
    """A process refused its configuration; the message is the line that it printed."""


class AnyChild(Protocol):
    """What is asked of a process: see `Child`."""

    name: str
    tail: deque[str]

    @property
    def pid(self) -> int | None:
        """Process id while the process runs."""

    @property
    def stopped(self) -> bool:
        """Whether the process is there but was stopped."""

    @property
    def waited(self) -> float:
        """For how long [s] it has been kept waiting for a processor so far."""

    @property
    def alive_seconds(self) -> float:
        """Time [s] since the process was started."""

    def start(self) -> None:
        """Start the process, behind its gate."""

    def release(self) -> None:
        """Let the process through its gate."""

    async def wait(self) -> int:
        """Exit code of the process."""

    def terminate(self) -> None:
        """Ask the process to end."""

    def kill(self) -> None:
        """End the process at once."""


class Watched:
    """A child, whether it may start and has done so, and how often it died."""

    def __init__(self, child: AnyChild, *, again: bool = True) -> None:
        self.child = child
        self.again = again  # is started again when it ends
        self.admitted = False
        self.backoff = Backoff()
        self.ready = asyncio.Event()
        self.gone = asyncio.Event()
        self.status = ServiceStatus(name=child.name, state="waiting")
        self.killed_because = ""


class Supervisor:
    """The processes of a cell: `start` returns when all are ready, `stop` when all are gone.

    Readiness is told from outside (`mark_alive`), because it travels over the network that the first of the
    processes, the router, provides.
    """

    def __init__(
        self, cell: Cell, launch: Launch, on_line: Callable[[str, str], None],
        watchers: Mapping[str, Sequence[str]] = {},
        make_child: Callable[[str, Sequence[str], Mapping[str, str], Callable[[str, str], None]], AnyChild] = Child,
    ) -> None:
        """Prepare the processes without starting any; on the running loop.

        Args:
            cell: the resolved cell; its services are started in their order.
            launch: how the cell was asked for.
            on_line: called with the name of a process and each line that it writes.
            watchers: commands, by name, of processes that look on: ready before all services and ended after them,
                not started again when they end, without which the cell goes on.
            make_child: makes a process from its name, command, environment and `on_line`; a simulation has its own.
        """
        environment = launch.environment()
        self._services = [
            Watched(make_child(name, command, environment, on_line), again=False) for name, command in watchers.items()
        ] + [
            Watched(make_child(entry.name, launch.service_command(entry), environment, on_line))
            for entry in cell.services.values()
        ]
        self._router = None
        if not launch.connect:
            small = remapped_small_keys(entry.topics for entry in cell.services.values())
            self._router = Watched(make_child(ROUTER, launch.router_command(small), environment, on_line))
        self._all = [self._router, *self._services] if self._router else list(self._services)
        self._by_name = {watched.child.name: watched for watched in self._all}
        self._tasks: set[asyncio.Task[None]] = set()
        self.failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()  # only ever an exception
        self._up = False
        self._stopping = asyncio.Event()
        self.changed = asyncio.Event()  # set whenever `statuses` differs from before

    @property
    def statuses(self) -> list[ServiceStatus]:
        """All processes as they are now, the router first."""
        return [watched.status.model_copy(update={"pid": watched.child.pid}) for watched in self._all]

    @property
    def restarts(self) -> dict[str, int]:
        """How often each process was started again."""
        return {watched.child.name: watched.status.restarts for watched in self._all}

    def begin(self) -> None:
        """Start all processes at once, the services behind their gates, so that their imports overlap."""
        for watched in self._all:
            watched.admitted = watched is self._router
            task = asyncio.create_task(self._keep(watched), name=f"keep {watched.child.name}")
            self._tasks.add(task)
            task.add_done_callback(self._kept)

    async def reach_router(self, reaching: Awaitable[T]) -> T:
        """The result of reaching the router, unless a process fails first or it takes too long.

        Raises:
            BadConfiguration: a process ended with exit code 2; the message is its last line.
            StartFailed: the router was not reached in time; the message has its last lines.
        """
        reached = await self._unless_failed(reaching, self._router, ROUTER)
        if self._router:
            self._become_ready(self._router)
        return reached

    async def admit_all(self) -> None:
        """Let the services through in order, each when those before it are ready; returns when all are.

        Raises:
            BadConfiguration: a process ended with exit code 2; the message is its last line.
            StartFailed: a service was not ready in time; the message has its last lines.
        """
        for watched in self._services:
            watched.admitted = True
            if watched.child.pid is not None:
                self._set(watched, state="starting")
                watched.child.release()
            await self._unless_failed(watched.ready.wait(), watched, watched.child.name)
        self._up = True

    def mark_alive(self, name: str, alive: bool) -> None:
        """Take note that the readiness token of a service appeared or vanished; other names are ignored."""
        watched = self._by_name.get(name)
        if watched is None or watched is self._router or not watched.admitted:
            return
        if alive and watched.child.pid is not None:
            self._become_ready(watched)
        # A token also vanishes when the router dies. Only the end of the process counts as its death.

    def mark_connected(self, connected: bool) -> None:
        """Take note that the connection to the router was made or lost."""
        if self._router and connected and self._router.child.pid is not None:
            self._become_ready(self._router)

    @property
    def kept(self) -> list[ServiceStatus]:
        """The processes that are started again when they end, once the cell is up; none before and while it stops."""
        if not self._up or self._stopping.is_set():
            return []
        return [watched.status.model_copy(update={"pid": watched.child.pid}) for watched in self._all if watched.again]

    @property
    def starting(self) -> list[str]:
        """Names of the processes on their way to be ready."""
        return [watched.child.name for watched in self._all if watched.status.state == "starting"]

    @property
    def stopped(self) -> list[str]:
        """Names of those of them that the system does not run (SIGSTOP)."""
        return [name for name in self.starting if self._by_name[name].child.stopped]

    @property
    def waited(self) -> dict[str, float]:
        """For how long [s] each of those that are kept has been waiting for a processor so far."""
        return {watched.child.name: watched.child.waited for watched in self._all if watched.again}

    def kill(self, name: str, reason: str) -> None:
        """End a process that is of no use any more; it is started again."""
        log.error("%s %s; killed", name, reason)
        self._by_name[name].killed_because = reason
        self._by_name[name].child.kill()

    async def stop(self, hurry: asyncio.Event | None = None) -> None:
        """End all processes in reverse order: SIGTERM, then SIGKILL; at once when `hurry` is set."""
        self._stopping.set()
        hurry = hurry or asyncio.Event()
        deadline = monotonic() + STOP_TIMEOUT
        ending: set[asyncio.Task[None]] = set()
        for watched in reversed(self._all):
            # The others say goodbye through the router, and those that look on want to hear it.
            if (watched is self._router or not watched.again) and ending:
                await asyncio.wait(ending, timeout=max(0.0, deadline - 0.5 - monotonic()))
            latest = monotonic() + TERM_TIMEOUT
            # Who looks on has its whole time, however long the others took: it may have much to write.
            task = asyncio.create_task(self._end(watched, min(deadline, latest) if watched.again else latest, hurry))
            ending.add(task)
            await asyncio.wait({task}, timeout=0 if hurry.is_set() else HEAD_START)
        await asyncio.wait(ending)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def abandon(self) -> None:
        """Look after no process any more and leave them as they are, as when this one is killed: for simulations."""
        for task in self._tasks:
            task.cancel()

    # --- one process ----------------------------------------------------------------------------------------------

    async def _keep(self, watched: Watched) -> None:
        """Start the process again whenever it ends, until the cell stops."""
        child = watched.child
        try:
            while not self._stopping.is_set():
                child.start()
                if watched.admitted:
                    child.release()
                if self._stopping.is_set():  # it was asked to end before there was anything to ask
                    child.terminate()
                self._set(watched, state="starting" if watched.admitted else "waiting")
                code = await child.wait()
                if self._stopping.is_set():
                    break
                watched.ready.clear()
                if code == CONFIG_EXIT and not self._up:
                    self._set(watched, state="failed", message=describe_exit(code))
                    raise BadConfiguration(_last_message(child) or f"{child.name}: {describe_exit(code)}")
                if not watched.again:
                    self._set(watched, state="failed", message=describe_exit(code))
                    if not self._up:
                        raise StartFailed(_last_message(child) or f"{child.name}: {describe_exit(code)}")
                    log.error("%s ended (%s)", child.name, describe_exit(code))
                    break
                delay = watched.backoff.after(child.alive_seconds)
                message, watched.killed_because = watched.killed_because or describe_exit(code), ""
                log.warning("%s ended (%s); starting it again in %.1f s", child.name, message, delay)
                self._set(watched, state="restarting", restarts=watched.status.restarts + 1, message=message)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(delay):
                        await self._stopping.wait()
        finally:
            self._set(watched, state="failed" if watched.status.state == "failed" else "stopped")
            watched.gone.set()

    def _kept(self, task: asyncio.Task[None]) -> None:
        if task.cancelled() or self.failure.done():
            return
        if error := task.exception():
            self.failure.set_exception(error)
            self.failure.exception()  # it may be that nobody waits for it any more

    async def _end(self, watched: Watched, deadline: float, hurry: asyncio.Event) -> None:
        """End one process by the deadline [s, monotonic], or as soon as there is a hurry."""
        if watched.child.pid is not None:
            self._set(watched, state="stopping")
        watched.child.terminate()
        gone = asyncio.create_task(watched.gone.wait())
        hurried = asyncio.create_task(hurry.wait())
        left = max(0.0, deadline - monotonic())
        await asyncio.wait({gone, hurried}, timeout=left, return_when=asyncio.FIRST_COMPLETED)
        if not gone.done():
            if watched.child.pid is not None:
                log.warning("%s does not end; killed", watched.child.name)
            watched.child.kill()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await gone
        hurried.cancel()

    async def _unless_failed(self, reaching: Awaitable[T], watched: Watched | None, name: str) -> T:
        """The result of something that a process has to reach in time, while no process has failed."""
        waited = asyncio.ensure_future(reaching)
        try:
            either: set[asyncio.Future[Any]] = {waited, self.failure}
            await asyncio.wait(either, timeout=START_TIMEOUT, return_when=asyncio.FIRST_COMPLETED)
            if self.failure.done():
                self.failure.result()
            if waited.done():
                return waited.result()
            tail = list(watched.child.tail)[-SHOWN_LINES:] if watched else []
            said = "; its last lines:\n  " + "\n  ".join(tail) if tail else "; it said nothing"
            if watched:
                self._set(watched, state="failed", message=f"not ready within {START_TIMEOUT:g} s")
            raise StartFailed(f"{name} was not ready within {START_TIMEOUT:g} s{said if watched else ''}")
        finally:
            waited.cancel()

    def _become_ready(self, watched: Watched) -> None:
        if watched.ready.is_set():
            return
        watched.ready.set()
        seconds = watched.child.alive_seconds
        if watched.status.restarts:
            log.info("%s is ready again after %.1f s", watched.child.name, seconds)
        self._set(watched, state="ready", ready_seconds=seconds, message="")

    def _set(self, watched: Watched, **update: object) -> None:
        watched.status = watched.status.model_copy(update=update)
        self.changed.set()


def _last_message(child: AnyChild) -> str:
    """What a process said last, without level and name in front: plain, logged as text, or logged as JSON."""
    said = [_message_of(line) for line in child.tail]
    errors = [message for level, message in said if level == "error"]
    return errors[-1] if errors else said[-1][1] if said else ""


def _message_of(line: str) -> tuple[str, str]:
    """Level and message of a line; the level is empty where there is none."""
    if line.startswith("{"):
        with contextlib.suppress(ValueError, KeyError):
            value = json.loads(line)
            return str(value.get("level", "")), str(value["message"])
    if match := re.match(r"(DEBUG|INFO|WARNING|ERROR|CRITICAL) [\w.]+: (.*)", line):
        return match[1].lower(), match[2]
    return "", line.removeprefix("zencell: ")
