"""A process of a simulated cell: a service's own `run`, in a life of its own that can end in the middle of anything."""

from __future__ import annotations

import asyncio
import importlib
import logging
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from common.clock import Clock
from common.config import Cell, ServiceEntry, service_config
from common.errors import NoResponder, RemoteError, RequestFailed, RequestLost, RequestTimeout
from common.messages import Message
from common.process.log import BusLog
from common.process.service import serve
from common.sources import monotonic
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
    """The clock of a host that is wrong by a little."""

    def __init__(self, like: Clock, skew_ns: int) -> None:
        """Be as far from the cell's clock as said."""
        self._skew_ns = skew_ns
        super().__init__(like.speed, like.epoch_ns, like.booted_ns)

    def _wall_ns(self) -> int:
        return super()._wall_ns() + self._skew_ns


@dataclass
class RequestLog:
    """What became of all requests of a cell, those that are under way, and what was read that should not have been."""

    outcomes: Counter[str] = field(default_factory=Counter)
    open: dict[int, tuple[str, str, float]] = field(default_factory=dict)  # service, key, latest end [s, monotonic]
    strange: list[str] = field(default_factory=list)  # what ended in none of the five ways
    repeated: list[str] = field(default_factory=list)  # what was read again, or after what is newer
    read: int = 0  # messages
    begun: int = 0
    on_begin: Callable[[str, str, str], None] = lambda asker, asked, key: None
    on_ask: Callable[[str, Message], None] = lambda service, request: None
    on_serve: Callable[[str, Message, Message], None] = lambda life, request, answer: None
    on_answer: Callable[[str, Message, Message], None] = lambda service, request, answer: None


class _WatchedClient(Client[Q, A]):
    """A client of whose requests is noted how they end."""

    noted: RequestLog

    async def call(self, request: Q, timeout: float = 5.0) -> A:
        """The answer to a request."""
        noted = self.noted
        noted.on_begin(self._service, self.server, self.topic.key)
        noted.on_ask(self._service, request)
        number = noted.begun = noted.begun + 1
        noted.open[number] = self._service, self.topic.key, monotonic() + timeout
        try:
            answer = await super().call(request, timeout)
        except RequestFailed as failed:
            noted.outcomes[OUTCOMES[type(failed)]] += 1
            raise
        except (asyncio.CancelledError, GeneratorExit):  # whoever asked does not want to know any more
            noted.outcomes["given up"] += 1
            raise
        except BaseException as error:
            noted.strange.append(f"{self._service}: {self.topic.key} ended in {type(error).__name__}: {error}")
            raise
        finally:
            noted.open.pop(number, None)
        noted.outcomes["answered"] += 1
        noted.on_answer(self._service, request, answer)
        return answer


class _WatchedReader(Reader[M]):
    """A reader that notes what it should have left out."""

    noted: RequestLog

    def _decode(self, arrived: Any) -> bool:
        known: dict[str, int] = self.__dict__.setdefault("_known", {})
        self.noted.read += 1
        if arrived.message is None and (sent := arrived.attachment) is not None:
            if sent.sequence <= known.get(sent.writer, -1):
                self.noted.repeated.append(f"{self.topic.key} of {sent.writer} was read again, or after a newer one")
            known[sent.writer] = sent.sequence
        return super()._decode(arrived)


class SimulatedBus(Bus):
    """A bus of whose requests is noted how they end, with a log of its own."""

    make_reader, make_client = _WatchedReader, _WatchedClient
    has_threads = has_process = False

    def __init__(
        self, session: SimulatedSession, service: str, cell: str, clock: Clock, noted: RequestLog,
        topics: Mapping[str, str] | None = None,
    ) -> None:
        """Take a place in a cell."""
        super().__init__(session, service=service, cell=cell, clock=clock, topics=topics)
        self.session = session
        self.log = logging.Logger(service, logging.INFO)  # known to nobody else in this process
        self.log.addHandler(BusLog(self))
        self._noted = noted

    def client(self, topic: Request[Q, A]) -> Client[Q, A]:
        """A client of the request key."""
        client = super().client(topic)
        assert isinstance(client, _WatchedClient)
        client.noted = self._noted
        return client

    def serve(self, topic: Request[Q, A], handler: Callable[[Q], Awaitable[A]], **how: Any) -> None:
        """Answer requests, of which is noted what is answered."""

        async def watched(request: Q) -> A:
            answer = await handler(request)
            self._noted.on_serve(self.session.life, request, answer)
            return answer

        super().serve(topic, watched, **how)

    def reader(self, topic: Topic[M], *, size: int = 1000, listening: bool = True) -> Reader[M]:
        """A reader of the topic."""
        reader = super().reader(topic, size=size, listening=listening)
        assert isinstance(reader, _WatchedReader)
        reader.noted = self._noted
        return reader


@dataclass
class SimulatedHost:
    """Where the processes of a simulated cell run, and what they share."""

    loop: VirtualTimeLoop
    network: SimulatedNetwork
    cell: Cell
    clock: Clock
    random: np.random.Generator
    requests: RequestLog = field(default_factory=RequestLog)
    processes: dict[str, SimulatedProcess] = field(default_factory=dict)
    ended: list[tuple[Incarnation, asyncio.Task[int]]] = field(default_factory=list)  # cut off, not cleared away yet
    started: int = 0
    skews: dict[str, float] = field(default_factory=dict)  # by service [s]
    crashes: list[str] = field(default_factory=list)  # of services, by themselves
    twice: Counter[str] = field(default_factory=Counter)  # instances that were started beside those of the supervisor
    refused: int = 0  # instances, because another one was up

    def clear_away(self) -> list[asyncio.Task[int]]:
        """Let everything that was cut off come to its end, far from the network; returns what has to end."""
        tasks = []
        for life, task in self.ended:
            self.loop.revive(life)
            task.cancel()
            tasks.append(task)
        self.ended.clear()
        return tasks


class _Ending:
    """Whether and why a process was asked to end."""

    reason = ""

    @property
    def stopping(self) -> bool:
        return bool(self.reason)


class SimulatedProcess:
    """A child of the supervisor that is a task of this process."""

    def __init__(
        self, host: SimulatedHost, entry: ServiceEntry, on_line: Callable[[str, str], None], *, beside: bool = False
    ) -> None:
        """Describe a process without starting it; `beside` that of the supervisor, which knows nothing of it."""
        self.name = entry.name
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.life = Incarnation(self.name)
        self.bus: SimulatedBus | None = None
        self._host, self._entry, self._on_line = host, entry, on_line
        self._pid: int | None = None
        self._began = 0.0
        self._code: asyncio.Future[int] | None = None
        self._gate: asyncio.Event | None = None
        self._task: asyncio.Task[int] | None = None
        self._session: SimulatedSession | None = None
        self._ending = _Ending()
        if beside:
            host.twice[self.name] += 1
        else:
            host.processes[self.name] = self

    @property
    def pid(self) -> int | None:
        """A number while it runs."""
        return self._pid

    @property
    def stopped(self) -> bool:
        """Never."""
        return False

    @property
    def waited(self) -> float:
        """Never for a processor."""
        return 0.0

    @property
    def alive_seconds(self) -> float:
        """Time [s] since it was started."""
        return monotonic() - self._began

    def start(self) -> None:
        """Start it, behind its gate."""
        host = self._host
        host.started += 1
        self._pid, self._began = 1000 + host.started, monotonic()
        self.life, self._ending = Incarnation(self.name), _Ending()
        self._code, self._gate = host.loop.create_future(), asyncio.Event()
        context = context_of(self.life)
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
        bus.log.addHandler(_Tail(self._say))
        try:
            return await serve(module.run, bus, config, self._ending)
        finally:
            await bus.close()
            session.close()

    def _say(self, line: str) -> None:
        self.tail.append(line)
        self._on_line(self.name, line)

    def _done(self, task: asyncio.Task[int]) -> None:
        if task is not self._task or self._pid is None:  # it was cut off, and is cleared away now
            return
        if task.cancelled():
            code = SIGTERM_CODE
        elif (error := task.exception()) is not None:
            code = 1
            self._host.crashes.append(f"{self.name}: {type(error).__name__}: {error}")
        elif (code := task.result()) == REFUSED and self._host.twice[self.name]:
            self._host.refused += 1
        elif code and not self._ending.stopping:
            self._host.crashes.append(f"{self.name}: {self.tail[-1] if self.tail else f'exit code {code}'}")
        self._gone(code)

    def _gone(self, code: int) -> None:
        if self._pid is None:
            return
        self._pid = None
        if self._session is not None:
            self._host.network.detach(self._session)
        if self._code is not None and not self._code.done():
            self._code.set_result(code)

    def release(self) -> None:
        """Let it through its gate."""
        if self._gate is not None:
            self._gate.set()

    async def wait(self) -> int:
        """Its exit code."""
        assert self._code is not None, "not started"
        return await asyncio.shield(self._code)

    def terminate(self) -> None:
        """Ask it to end, as SIGTERM does."""
        if self._pid is not None and self._task is not None:
            self._ending.reason = self._ending.reason or "SIGTERM"
            self._task.cancel()

    def kill(self) -> None:
        """End it where it is, as SIGKILL does: nothing of it runs any more."""
        if self._pid is None or self._task is None:
            return
        host = self._host
        self._ending.reason = "SIGKILL"
        host.loop.end(self.life)
        host.ended.append((self.life, self._task))
        host.requests.open = {n: r for n, r in host.requests.open.items() if r[0] != self.name}
        self._gone(SIGKILL)

    @property
    def session(self) -> SimulatedSession | None:
        """Its place on the network while it runs."""
        return self._session if self._pid is not None else None

    def kill_at_turn(self, turns: int) -> None:
        """End it in that many turns of its own, counted from now: in the middle of whatever it does then."""
        self.life.at_turn = self.life.turns + max(1, turns), self.kill


class _Tail(logging.Handler):
    """Passes log lines on as they would stand on stderr."""

    def __init__(self, say: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        self._say(self.format(record))
