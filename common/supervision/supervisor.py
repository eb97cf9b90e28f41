"""The supervisor of a cell's processes: starts them in order, restarts those that die, and leaves none behind."""

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

START_TIMEOUT = 15.0  # [s] from the opening of a gate to the readiness token
HEAD_START = 0.5  # [s] at most between SIGTERM to one service and to the one before it
TERM_TIMEOUT = 5.0  # [s] from SIGTERM to SIGKILL
STOP_TIMEOUT = 6.5  # [s] after which every service that still runs is killed
SHOWN_LINES = 5  # last log lines in the error of a service that did not become ready
CONFIG_EXIT = 2  # exit code of a process with a bad configuration: a restart would not help

log = logging.getLogger("supervisor")


class StartFailed(ZencellError):
    """The cell did not come up, for another reason than its configuration."""

    exit_code = 1


class BadConfiguration(ZencellError):
    """A process rejected its configuration; the message is the line that it printed."""


class ChildProcess(Protocol):
    """The interface of a process: see `Child`."""

    name: str
    tail: deque[str]

    @property
    def pid(self) -> int | None:
        """Process id while the process runs."""

    @property
    def stopped(self) -> bool:
        """Whether the process exists but is stopped."""

    @property
    def waited(self) -> float:
        """Total time [s] that it waited for a processor."""

    @property
    def alive_seconds(self) -> float:
        """Time [s] since the process was started."""

    def start(self) -> None:
        """Start the process, behind its gate."""

    def release(self) -> None:
        """Open the gate."""

    async def wait(self) -> int:
        """Return the exit code."""

    def terminate(self) -> None:
        """Ask the process to end."""

    def kill(self) -> None:
        """Kill the process."""


class SupervisedProcess:
    """A child process with its state and number of restarts."""

    def __init__(self, child: ChildProcess, *, again: bool = True) -> None:
        self.child = child
        self.again = again  # whether it is restarted when it ends
        self.admitted = False  # whether its gate may open
        self.backoff = Backoff()
        self.ready = asyncio.Event()
        self.gone = asyncio.Event()
        self.status = ServiceStatus(name=child.name, state="waiting")
        self.killed_because = ""


class Supervisor:
    """The processes of a cell: `start` starts them, `admit_all` returns when all are ready, `stop` when all are gone.

    Callers report readiness with `mark_alive`, because readiness tokens travel over the network of the router, which is
    the first of the processes.
    """

    def __init__(
        self, cell: Cell, launch: Launch, on_line: Callable[[str, str], None],
        watchers: Mapping[str, Sequence[str]] = {},
        make_child: Callable[[str, Sequence[str], Mapping[str, str], Callable[[str, str], None]], ChildProcess] = Child,
        start_timeout: float = START_TIMEOUT, term_timeout: float = TERM_TIMEOUT,
    ) -> None:
        """Prepare the processes without starting any, on the running loop.

        Args:
            cell: the resolved cell; its services are started in their order.
            launch: options of the launch.
            on_line: called with the name of a process and each line that it writes.
            watchers: commands, by name, of observing processes such as a recorder. They are ready before all services
                and end after them; they are not restarted, and the cell continues without them.
            make_child: makes a process from its name, command, environment and `on_line`; a simulation has its own.
            start_timeout: [s] from the opening of a gate to the readiness token.
            term_timeout: [s] from SIGTERM to SIGKILL.
        """
        environment = launch.environment()
        self._start_timeout, self._term_timeout = start_timeout, term_timeout
        self._services = [
            SupervisedProcess(make_child(name, command, environment, on_line), again=False)
            for name, command in watchers.items()
        ] + [
            SupervisedProcess(make_child(entry.name, launch.service_command(entry), environment, on_line))
            for entry in cell.services.values()
        ]
        self._router = None
        if not launch.connect:
            small = remapped_small_keys(cell.tables)
            self._router = SupervisedProcess(make_child(ROUTER, launch.router_command(small), environment, on_line))
        self._all = [self._router, *self._services] if self._router else list(self._services)
        self._by_name = {watched.child.name: watched for watched in self._all}
        self._tasks: set[asyncio.Task[None]] = set()
        self.failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()  # gets only an exception
        self._up = False
        self._stopping = asyncio.Event()
        self.changed = asyncio.Event()  # set after each change of `statuses`

    @property
    def statuses(self) -> list[ServiceStatus]:
        """Current state of all processes, the router first."""
        return [watched.status.model_copy(update={"pid": watched.child.pid}) for watched in self._all]

    @property
    def restarts(self) -> dict[str, int]:
        """Number of restarts of each process."""
        return {watched.child.name: watched.status.restarts for watched in self._all}

    def start(self) -> None:
        """Start all processes at once, the services behind their gates, so that their imports overlap."""
        for watched in self._all:
            watched.admitted = watched is self._router
            task = asyncio.create_task(self._keep_running(watched), name=f"keep {watched.child.name} running")
            self._tasks.add(task)
            task.add_done_callback(self._on_task_done)

    async def reach_router(self, reaching: Awaitable[T]) -> T:
        """Return the result of connecting to the router, unless a process fails first or it takes too long.

        Raises:
            BadConfiguration: a process ended with exit code 2; the message is its last line.
            StartFailed: the router was not reached in time; the message has its last lines.
        """
        reached = await self._unless_failed(reaching, self._router, ROUTER)
        if self._router:
            self._become_ready(self._router)
        return reached

    async def admit_all(self) -> None:
        """Open the gates in order, each when the services before it are ready; return when all are ready.

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
        """Record that the readiness token of a service appeared or vanished; unknown names are ignored."""
        watched = self._by_name.get(name)
        if watched is None or watched is self._router or not watched.admitted:
            return
        if alive and watched.child.pid is not None:
            self._become_ready(watched)
        # A token also vanishes when the router dies. Only the end of the process counts as its death.

    def mark_connected(self, connected: bool) -> None:
        """Record whether the router is connected."""
        if self._router and connected and self._router.child.pid is not None:
            self._become_ready(self._router)

    @property
    def restartable(self) -> list[ServiceStatus]:
        """The processes that are restarted when they end; empty before the cell is up and while it stops."""
        if not self._up or self._stopping.is_set():
            return []
        return [watched.status.model_copy(update={"pid": watched.child.pid}) for watched in self._all if watched.again]

    @property
    def starting(self) -> list[str]:
        """Names of the processes that are not ready yet."""
        return [watched.child.name for watched in self._all if watched.status.state == "starting"]

    @property
    def stopped(self) -> list[str]:
        """Names of those that are stopped (SIGSTOP) before they are ready."""
        return [name for name in self.starting if self._by_name[name].child.stopped]

    @property
    def waited(self) -> dict[str, float]:
        """Total time [s] that each restartable process waited for a processor."""
        return {watched.child.name: watched.child.waited for watched in self._all if watched.again}

    def kill(self, name: str, reason: str) -> None:
        """Kill a process and log the reason; it is restarted."""
        log.error("%s %s; killed", name, reason)
        self._by_name[name].killed_because = reason
        self._by_name[name].child.kill()

    async def stop(self, hurry: asyncio.Event | None = None) -> None:
        """End all processes in reverse order: SIGTERM, then SIGKILL, which comes at once when `hurry` is set."""
        self._stopping.set()
        hurry = hurry or asyncio.Event()
        deadline = monotonic() + STOP_TIMEOUT
        ending: set[asyncio.Task[None]] = set()
        for watched in reversed(self._all):
            # Services publish their last messages through the router, and observers record them: both end last.
            if (watched is self._router or not watched.again) and ending:
                await asyncio.wait(ending, timeout=max(0.0, deadline - 0.5 - monotonic()))
            latest = monotonic() + self._term_timeout
            # An observer gets its full timeout, however long the services took: it may have much to write.
            task = asyncio.create_task(self._end(watched, min(deadline, latest) if watched.again else latest, hurry))
            ending.add(task)
            await asyncio.wait({task}, timeout=0 if hurry.is_set() else HEAD_START)
        await asyncio.wait(ending)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def abandon(self) -> None:
        """Stop supervising and leave the processes as they are, as if this one were killed; for simulations."""
        for task in self._tasks:
            task.cancel()

    # --- one process ----------------------------------------------------------------------------------------------

    async def _keep_running(self, watched: SupervisedProcess) -> None:
        """Restart the process whenever it ends, until the cell stops."""
        child = watched.child
        try:
            while not self._stopping.is_set():
                child.start()
                if watched.admitted:
                    child.release()
                if self._stopping.is_set():  # `stop` was called before there was a process
                    child.terminate()
                self._set(watched, state="starting" if watched.admitted else "waiting")
                code = await child.wait()
                if self._stopping.is_set():
                    break
                watched.ready.clear()
                self._check_fatal(watched, code)
                if not watched.again:
                    log.error("%s ended (%s)", child.name, describe_exit(code))
                    break
                delay = watched.backoff.after(child.alive_seconds)
                message, watched.killed_because = watched.killed_because or describe_exit(code), ""
                log.warning("%s ended (%s); restarting it in %.1f s", child.name, message, delay)
                self._set(watched, state="restarting", restarts=watched.status.restarts + 1, message=message)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(delay):
                        await self._stopping.wait()
        finally:
            self._set(watched, state="failed" if watched.status.state == "failed" else "stopped")
            watched.gone.set()

    def _check_fatal(self, watched: SupervisedProcess, code: int) -> None:
        """Raise if the end of a process ends the start of the cell: bad configuration, or an observer that failed."""
        bad_configuration = code == CONFIG_EXIT and not self._up
        if not bad_configuration and watched.again:
            return
        self._set(watched, state="failed", message=describe_exit(code))
        if not self._up:
            error = BadConfiguration if bad_configuration else StartFailed
            raise error(_last_message(watched.child) or f"{watched.child.name}: {describe_exit(code)}")

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        if task.cancelled() or self.failure.done():
            return
        if error := task.exception():
            self.failure.set_exception(error)
            self.failure.exception()  # mark it as retrieved: nothing may wait for it any more

    async def _end(self, watched: SupervisedProcess, deadline: float, hurry: asyncio.Event) -> None:
        """End one process by the deadline [s, monotonic], or as soon as `hurry` is set."""
        if watched.child.pid is not None:
            self._set(watched, state="stopping")
        watched.child.terminate()
        gone = asyncio.create_task(watched.gone.wait())
        hurried = asyncio.create_task(hurry.wait())
        left = max(0.0, deadline - monotonic())
        await asyncio.wait({gone, hurried}, timeout=left, return_when=asyncio.FIRST_COMPLETED)
        if not gone.done():
            if watched.child.pid is not None:
                log.warning("%s did not end in time; killed", watched.child.name)
            watched.child.kill()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await gone
        hurried.cancel()

    async def _unless_failed(self, reaching: Awaitable[T], watched: SupervisedProcess | None, name: str) -> T:
        """Return the result of `reaching`, a step in the start of a process, within the start timeout."""
        waited = asyncio.ensure_future(reaching)
        try:
            either: set[asyncio.Future[Any]] = {waited, self.failure}
            await asyncio.wait(either, timeout=self._start_timeout, return_when=asyncio.FIRST_COMPLETED)
            if self.failure.done():
                self.failure.result()
            if waited.done():
                return waited.result()
            tail = list(watched.child.tail)[-SHOWN_LINES:] if watched else []
            output = "; its last lines:\n  " + "\n  ".join(tail) if tail else "; it wrote nothing"
            if watched:
                self._set(watched, state="failed", message=f"not ready within {self._start_timeout:g} s")
            raise StartFailed(f"{name} was not ready within {self._start_timeout:g} s{output if watched else ''}")
        finally:
            waited.cancel()

    def _become_ready(self, watched: SupervisedProcess) -> None:
        if watched.ready.is_set():
            return
        watched.ready.set()
        seconds = watched.child.alive_seconds
        if watched.status.restarts:
            log.info("%s is ready again after %.1f s", watched.child.name, seconds)
        self._set(watched, state="ready", ready_seconds=seconds, message="")

    def _set(self, watched: SupervisedProcess, **update: object) -> None:
        watched.status = watched.status.model_copy(update=update)
        self.changed.set()


def _last_message(child: ChildProcess) -> str:
    """Return the last error, else the last line of a process, without its level and name."""
    lines = [_message_of(line) for line in child.tail]
    errors = [message for level, message in lines if level == "error"]
    return errors[-1] if errors else lines[-1][1] if lines else ""


def _message_of(line: str) -> tuple[str, str]:
    """Return level and message of a line of text or JSON; the level is empty if it has none."""
    if line.startswith("{"):
        with contextlib.suppress(ValueError, KeyError):
            value = json.loads(line)
            return str(value.get("level", "")), str(value["message"])
    if match := re.match(r"(DEBUG|INFO|WARNING|ERROR|CRITICAL) [\w.]+: (.*)", line):
        return match[1].lower(), match[2]
    return "", line.removeprefix("zencell: ")
