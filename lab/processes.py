"""Processes of a simulated cell: each runs a service's own `run` as a task that can be killed at any `await`."""

from __future__ import annotations

import asyncio
import importlib
import logging
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from common.clock import Clock
from common.config import Cell, ServiceEntry, service_config
from common.errors import NoResponder, RemoteError, RequestFailed, RequestLost, RequestTimeout
from common.messages import Message
from common.process.log import BusLog
from common.process.service import serve
from common.time_source import monotonic
from common.topics import Request, Topic
from common.transport.bus import Bus, Client, Reader
from lab.loop import Incarnation, VirtualTimeLoop, context_of
from lab.network import SimulatedNetwork, SimulatedSession

Q = TypeVar("Q", bound=Message)
A = TypeVar("A", bound=Message)
M = TypeVar("M", bound=Message)

BOOT = 0.4, 1.2  # [s] from the start of a process to its first declaration
TAIL_LINES = 50
SIGKILL, SIGTERM_CODE, REFUSED = -9, 0, 2
OUTCOMES: dict[type[BaseException], str] = {
    RemoteError: "refused", NoResponder: "no responder", RequestLost: "lost", RequestTimeout: "time-out",
}


class SkewedClock(Clock):
    """Clock of a host whose system time is off by a constant."""

    def __init__(self, like: Clock, skew_ns: int) -> None:
        """Copy the cell's clock with a constant error [ns]."""
        self._skew_ns = skew_ns
        super().__init__(like.speed, like.epoch_ns, like.booted_ns)

    def _wall_ns(self) -> int:
        return super()._wall_ns() + self._skew_ns


@dataclass
class RequestLog:
    """Open requests of a cell, outcomes of the others, and violations of the transport's promises."""

    outcomes: Counter[str] = field(default_factory=Counter)
    open: dict[int, tuple[str, str, float]] = field(default_factory=dict)  # service, key, latest end [s, monotonic]
    unexpected: list[str] = field(default_factory=list)  # requests that ended in none of the five ways
    repeated: list[str] = field(default_factory=list)  # messages read twice, or after a newer one
    read: int = 0  # messages
    started: int = 0
    on_start: Callable[[str, str, str], None] = lambda client, server, key: None
    on_request: Callable[[str, Message, str], None] = lambda service, request, key: None
    on_serve: Callable[[str, Message, Message, str], None] = lambda instance, request, answer, key: None
    on_answer: Callable[[str, Message, Message, str], None] = lambda service, request, answer, key: None


class _LoggedClient(Client[Q, A]):
    """Client that logs how its requests end."""

    requests: RequestLog

    async def call(self, request: Q, timeout: float = 5.0) -> A:
        """Return the answer to a request."""
        requests = self.requests
        requests.on_start(self._service, self.server, self.topic.key)
        requests.on_request(self._service, request, self.topic.key)
        number = requests.started = requests.started + 1
        requests.open[number] = self._service, self.topic.key, monotonic() + timeout
        try:
            answer = await super().call(request, timeout)
        except RequestFailed as failed:
            requests.outcomes[OUTCOMES[type(failed)]] += 1
            raise
        except (asyncio.CancelledError, GeneratorExit):  # the client no longer waits
            requests.outcomes["given up"] += 1
            raise
        except BaseException as error:
            requests.unexpected.append(
                f"{self._service}: {self.topic.key} ended in {type(error).__name__}: {error}")
            raise
        finally:
            requests.open.pop(number, None)
        requests.outcomes["answered"] += 1
        requests.on_answer(self._service, request, answer, self.topic.key)
        return answer


class _LoggedReader(Reader[M]):
    """Reader that logs messages it should have dropped."""

    requests: RequestLog

    def _decode(self, arrived: Any) -> bool:
        known: dict[str, int] = self.__dict__.setdefault("_known", {})
        self.requests.read += 1
        if arrived.message is None and (sent := arrived.attachment) is not None:
            if sent.sequence <= known.get(sent.writer, -1):
                self.requests.repeated.append(f"{self.topic.key} of {sent.writer} was read twice, or after a newer one")
            known[sent.writer] = sent.sequence
        return super()._decode(arrived)


# The OS would keep the file lock of a simulated process that was killed, and threads run outside the virtual clock.
RUN_ARGUMENTS: dict[str, dict[str, Any]] = {
    "services.trajectory_executor": {"file_lock": lambda path, name: nullcontext(), "saver_for": lambda file: file},
}


class SimulatedBus(Bus):
    """Bus that logs requests and has a logger of its own."""

    reader_class, client_class = _LoggedReader, _LoggedClient

    def __init__(
        self, session: SimulatedSession, service: str, cell: str, clock: Clock, requests: RequestLog,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        """Join a cell."""
        super().__init__(session, service=service, cell=cell, clock=clock, topics=topics)
        self.session = session
        self.log = logging.Logger(service, logging.INFO)  # not registered: other simulated processes have the same name
        self.log.addHandler(BusLog(self))
        self._requests = requests

    def client(self, topic: Request[Q, A]) -> Client[Q, A]:
        """Return a client of the request key."""
        client = super().client(topic)
        assert isinstance(client, _LoggedClient)
        client.requests = self._requests
        return client

    def serve(self, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]], **how: Any) -> None:
        """Answer requests and log the answers."""
        key = self._remapping.key(topic.key)

        async def logged(request: Q) -> A:
            answer = await handler(request)
            self._requests.on_serve(self.session.instance, request, answer, key)
            return answer

        super().serve(topic, logged, **how)

    def reader(self, topic: Topic[M], *, size: int = 1000, listening: bool = True) -> Reader[M]:
        """Return a reader of the topic."""
        reader = super().reader(topic, size=size, listening=listening)
        assert isinstance(reader, _LoggedReader)
        reader.requests = self._requests
        return reader


@dataclass
class SimulatedHost:
    """What the processes of a simulated cell share."""

    loop: VirtualTimeLoop
    network: SimulatedNetwork
    cell: Cell
    clock: Clock
    random: np.random.Generator
    requests: RequestLog = field(default_factory=RequestLog)
    processes: dict[str, SimulatedProcess] = field(default_factory=dict)
    killed: list[tuple[Incarnation, asyncio.Task[int]]] = field(default_factory=list)  # not cleaned up yet
    started: int = 0
    skews: dict[str, float] = field(default_factory=dict)  # clock error by service [s]
    crashes: list[str] = field(default_factory=list)  # of services, not injected
    unsupervised: Counter[str] = field(default_factory=Counter)  # instances started besides those of the supervisor
    refused: int = 0  # second instances that ended because the first was up

    def clean_up(self) -> list[asyncio.Task[int]]:
        """Cancel the tasks of killed processes, which have left the network; return those tasks."""
        tasks = []
        for incarnation, task in self.killed:
            self.loop.revive(incarnation)
            task.cancel()
            tasks.append(task)
        self.killed.clear()
        return tasks


class _Ending:
    """Whether and why a process is asked to end."""

    reason = ""

    @property
    def stopping(self) -> bool:
        return bool(self.reason)


class SimulatedProcess:
    """Child of the supervisor that is a task of this process."""

    def __init__(
        self, host: SimulatedHost, entry: ServiceEntry, on_line: Callable[[str, str], None], *,
        unsupervised: bool = False,
    ) -> None:
        """Describe a process without starting it; the supervisor does not know an `unsupervised` one."""
        self.name = entry.name
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.incarnation = Incarnation(self.name)
        self.bus: SimulatedBus | None = None
        self._host, self._entry, self._on_line = host, entry, on_line
        self._pid: int | None = None
        self._started_at = 0.0
        self._code: asyncio.Future[int] | None = None
        self._gate: asyncio.Event | None = None
        self._task: asyncio.Task[int] | None = None
        self._session: SimulatedSession | None = None
        self._ending = _Ending()
        if unsupervised:
            host.unsupervised[self.name] += 1
        else:
            host.processes[self.name] = self

    @property
    def pid(self) -> int | None:
        """A unique number while the process runs."""
        return self._pid

    @property
    def stopped(self) -> bool:
        """Always false: SIGSTOP is not simulated."""
        return False

    @property
    def waited(self) -> float:
        """Always 0: waiting for a processor is not simulated."""
        return 0.0

    @property
    def alive_seconds(self) -> float:
        """Time since the start [s]."""
        return monotonic() - self._started_at

    def start(self) -> None:
        """Start the process; it waits at its gate."""
        host = self._host
        host.started += 1
        self._pid, self._started_at = 1000 + host.started, monotonic()
        self.incarnation, self._ending = Incarnation(self.name), _Ending()
        self._code, self._gate = host.loop.create_future(), asyncio.Event()
        context = context_of(self.incarnation)
        session = self._session = host.network.attach(context, self.name, self._pid)
        boot = float(host.random.uniform(*BOOT))
        task = self._task = context.run(lambda: asyncio.create_task(self._run(session, boot), name=self.name))
        task.add_done_callback(self._done)

    async def _run(self, session: SimulatedSession, boot: float) -> int:
        await asyncio.sleep(boot)
        assert self._gate is not None
        await self._gate.wait()
        host = self._host
        module: ModuleType = importlib.import_module(self._entry.module)
        config = service_config(host.cell, self.name, module.Config)
        clock = SkewedClock(host.clock, round(host.skews.get(self.name, 0.0) * 1e9))
        self.bus = bus = SimulatedBus(session, self.name, host.cell.name, clock, host.requests, self._entry.topics)
        bus.log.addHandler(_TailHandler(self._log))
        try:
            run = partial(module.run, **RUN_ARGUMENTS.get(self._entry.module, {}))
            return await serve(run, bus, config, self._ending)
        finally:
            await bus.close()
            session.close()

    def _log(self, line: str) -> None:
        self.tail.append(line)
        self._on_line(self.name, line)

    def _done(self, task: asyncio.Task[int]) -> None:
        if task is not self._task or self._pid is None:  # it was killed, and is cleaned up now
            return
        if task.cancelled():
            code = SIGTERM_CODE
        elif (error := task.exception()) is not None:
            code = 1
            self._host.crashes.append(f"{self.name}: {type(error).__name__}: {error}")
        elif (code := task.result()) == REFUSED and self._host.unsupervised[self.name]:
            self._host.refused += 1
        elif code and not self._ending.stopping:
            self._host.crashes.append(f"{self.name}: {self.tail[-1] if self.tail else f'exit code {code}'}")
        self._exit(code)

    def _exit(self, code: int) -> None:
        if self._pid is None:
            return
        self._pid = None
        if self._session is not None:
            self._host.network.detach(self._session)
        if self._code is not None and not self._code.done():
            self._code.set_result(code)

    def release(self) -> None:
        """Open the gate."""
        if self._gate is not None:
            self._gate.set()

    async def wait(self) -> int:
        """Return the exit code once the process has ended."""
        assert self._code is not None, "not started"
        return await asyncio.shield(self._code)

    def terminate(self) -> None:
        """End the process as SIGTERM does."""
        if self._pid is not None and self._task is not None:
            self._ending.reason = self._ending.reason or "SIGTERM"
            self._task.cancel()

    def kill(self) -> None:
        """End the process as SIGKILL does: nothing of it runs any more."""
        if self._pid is None or self._task is None:
            return
        host = self._host
        self._ending.reason = "SIGKILL"
        host.loop.end(self.incarnation)
        host.killed.append((self.incarnation, self._task))
        host.requests.open = {n: r for n, r in host.requests.open.items() if r[0] != self.name}
        self._exit(SIGKILL)

    @property
    def session(self) -> SimulatedSession | None:
        """Its session on the network while it runs."""
        return self._session if self._pid is not None else None

    def kill_at_turn(self, turns: int) -> None:
        """Kill the process after this many of its loop turns from now."""
        self.incarnation.at_turn = self.incarnation.turns + max(1, turns), self.kill


class _TailHandler(logging.Handler):
    """Passes log lines on as a process writes them to stderr."""

    def __init__(self, write: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
        self._write = write

    def emit(self, record: logging.LogRecord) -> None:
        self._write(self.format(record))
