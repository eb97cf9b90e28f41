"""One whole cell from its start to the end of its task, in this process and on a virtual clock."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import gc
import hashlib
import logging
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Coroutine, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from common import topics
from common.application import find_application
from common.clock import Clock
from common.config import Cell
from common.kept_file import STATE_VARIABLE
from common.messages import SupervisorStatus, TaskStatus
from common.sources import drawn_from
from common.supervision.launch import Launch
from common.supervision.operation import supervise
from common.supervision.supervisor import Supervisor
from common.transport.bus import Bus
from common.transport.codec import decode, decode_attachment
from common.transport.reader import Newness
from common.transport.session import RawSample
from lab.doubles import is_double
from lab.fault_injector import STRANGER, FaultInjector
from lab.faults import FaultPlan, make_plan
from lab.invariants import Invariants
from lab.loop import VirtualTimeLoop
from lab.network import SimulatedNetwork, SimulatedSession
from lab.observed_arm import observe_set_points, with_observed_arm
from lab.processes import RequestLog, SimulatedBus, SimulatedHost, SimulatedProcess
from recording.capture import CustomTopics
from recording.sample import Sample, message_of
from recording.writer import RUN, RecordingWriter, run_of

LIMIT = 300.0  # [s] virtual time in which the task has to end
LOOK = 0.5  # [s] of virtual time between looks at requests
SETTLE = 2.0  # [s] of virtual time for what still falls when the task has ended
CLEARING = 30.0  # [s] of virtual time for what was cut off to come to its end
SUPERVISOR, VISITOR, HOST = "supervisor", "visitor", "simulated"
STRANGERS = (VISITOR, STRANGER)  # who may say anything, also what is no message
ENDED, LEFT = ("DONE", "ERROR"), "LEFT"
NOTICED = 1.0  # [s] after which a process has noticed that its supervisor is gone
AGAIN = 0.1  # [s] between looks whether something has come about
SOONER = 0.5  # faults come in a cell with doubles, whose task takes half as long
LEFT_OUT = ("viewer",)  # a page in a browser has no place on a virtual clock

Visit = Callable[[Bus], Coroutine[Any, Any, None]]

log = logging.getLogger(__name__)


@dataclass
class Outcome:
    """What became of one seed. Times are virtual [s], but for `cpu_seconds`."""

    seed: int
    state: str = ""
    message: str = ""
    done: int = 0
    total: int = 0
    left: bool = False  # as a person ended its motion
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    messages: int = 0
    digest: str = ""  # of the message log: time, key, payload and attachment of every message
    restarts: dict[str, int] = field(default_factory=dict)
    crashes: list[str] = field(default_factory=list)  # of services by themselves
    requests: Counter[str] = field(default_factory=Counter)  # by outcome
    faults: Counter[str] = field(default_factory=Counter)  # that were made
    checked: Counter[str] = field(default_factory=Counter)  # how often each invariant was
    broken: list[str] = field(default_factory=list)  # invariants, with when and how

    @property
    def ok(self) -> bool:
        """Whether the task ended DONE, or a person ended its motion and nobody started it again."""
        return self.state in ("DONE", LEFT)


@dataclass
class _Up:
    """A supervisor that is there."""

    supervisor: Supervisor
    bus: SimulatedBus
    ready: asyncio.Event  # all services are
    working: asyncio.Task[None]
    lost: bool = False


class Simulation:
    """One run of a cell under one seed."""

    def __init__(
        self, cell: Cell, seed: int, *, faults: bool = False, limit: float = LIMIT, digest: bool = False,
        trace: Trace | None = None, tell: Callable[[str], None] = lambda line: None, visit: Visit | None = None,
        without: Collection[str] = (),
    ) -> None:
        """Prepare a run.

        Args:
            cell: resolved; its viewer is left out.
            seed: decides everything that is left open.
            faults: whether things go wrong.
            limit: virtual time in which the task has to end [s].
            digest: whether a digest of the message log is made.
            trace: takes all messages.
            tell: is called with each log line and each fault.
            visit: what somebody does in the cell, who came to see it; begins when all is ready, and the run ends with
                the task after it. The invariants do not look at what a visitor says.
            without: kinds of faults of which there are none.

        Raises:
            ConfigError: the cell has a real arm, or is none that can be simulated.
        """
        kept = {key: entry for key, entry in cell.services.items() if entry.name not in LEFT_OUT}
        self.cell = with_observed_arm(cell.model_copy(update={"services": kept}))
        names = [entry.name for entry in kept.values()]
        doubled = any(is_double(entry) for entry in kept.values())
        self.plan = make_plan(seed, names, SOONER if doubled else 1.0, without) if faults else FaultPlan()
        self.outcome = Outcome(seed)
        self._limit, self._trace, self._tell, self._visit = limit, trace, tell, visit
        self._failed: Exception | None = None  # of the visit
        self._hash = hashlib.blake2b(digest_size=16) if digest else None
        self._status = find_application(cell.application).status
        self._status_key = f"{cell.name}/{self._status.key}"
        self._last_status: RawSample | None = None
        self._ended = asyncio.Event()
        self._restarts: Counter[str] = Counter()  # of supervisors before
        self._over = False  # what the task says from now on does not count: somebody may have started it again
        self._loop = VirtualTimeLoop(seed, shuffled=self.plan.shuffled)
        self._network = SimulatedNetwork(self._loop, seed, self.plan.weather)
        self._network.on_put = self._on_put
        self._requests = RequestLog()
        self.invariants = Invariants(self.cell, self._requests, self._loop.time)
        self._network.on_listen = lambda session, key: self.invariants.on_listen(session.name, key)

    def run(self) -> Outcome:
        """What became of it; what the visit raises is raised."""
        began = time.process_time()
        with drawn_from(self._loop), observe_set_points(self.invariants.on_set_point), _state_folder(), _quiet():
            try:
                self._loop.run_until_complete(self._run())
            finally:
                self._loop.close()
        if self._hash is not None:
            self.outcome.digest = self._hash.hexdigest()
        self.outcome.cpu_seconds = time.process_time() - began
        if self._failed is not None:
            raise self._failed
        return self.outcome

    def kill(self, name: str) -> None:
        """End a process of the cell where it is, as SIGKILL does."""
        self._host.processes[name].kill()

    def lose_router(self, seconds: float) -> None:
        """Cut all links for a time [s], as when the router is started again."""
        self._network.lose_router()
        self._loop.call_later(seconds, self._network.find_router)

    async def _run(self) -> None:
        outcome, clock = self.outcome, Clock(self.plan.speed)
        host = SimulatedHost(
            self._loop, self._network, self.cell, clock, np.random.default_rng([outcome.seed, 4]), self._requests,
            skews=dict(self.plan.skews),
        )
        self._host = host
        self._misfortune = FaultInjector(host, self.plan, outcome.seed, self._status, self._say)
        self._misfortune.lose_supervisor, self._misfortune.persons.leave = self._bring_up_again, self._leave
        self._bring_up()
        playing = asyncio.create_task(self._play())
        try:
            await self._look_on(playing)
            up = self._up
            if up.supervisor.failure.done():
                outcome.state, outcome.message = "NOT STARTED", str(up.supervisor.failure.exception())
            elif up.working.done() and not up.working.cancelled() and (error := up.working.exception()) is not None:
                outcome.state, outcome.message = "NOT STARTED", f"{type(error).__name__}: {error}"
            self._judge()
        finally:
            for name, count in self._up.supervisor.restarts.items():
                self._restarts[name] += count
            outcome.restarts = {name: count for name, count in self._restarts.items() if count}
            outcome.crashes, outcome.requests = host.crashes, host.requests.outcomes
            outcome.faults = self._misfortune.made + self._network.counted
            outcome.broken, outcome.checked = self.invariants.broken, self.invariants.checked
            self.invariants.ended = True
            self._network.on_put = lambda session, sample: None  # what comes now is no part of the run
            await self._clear(playing, host)

    # --- the supervisor -----------------------------------------------------------------------------------------------

    def _bring_up(self) -> None:
        """Start a supervisor, which starts all services."""
        host, clock = self._host, self._host.clock
        entries = {entry.name: entry for entry in self.cell.services.values()}

        def make_child(name: str, _command: object, _environment: object, on_line: Callable[[str, str], None]) -> Any:
            return SimulatedProcess(host, entries[name], on_line)

        launch = Launch(cell=self.cell.name, connect="tcp/127.0.0.1:7447", clock=clock)
        host.started += 1
        session = self._network.attach(contextvars.copy_context(), SUPERVISOR, host.started)
        bus = SimulatedBus(session, SUPERVISOR, self.cell.name, clock, host.requests)
        supervisor = Supervisor(self.cell, launch, lambda name, line: self._say(line), make_child=make_child)
        # Which is put only while somebody listens.
        bus.raw_subscriber(f"{self.cell.name}/{topics.LOG.expression}", lambda sample: None)
        supervisor.begin()
        ready = asyncio.Event()

        async def work(_bus: Bus) -> None:
            ready.set()
            await asyncio.Event().wait()

        working = asyncio.create_task(supervise(bus, self.cell, launch, supervisor, work, host=HOST))
        self._up = _Up(supervisor, bus, ready, working)

    async def _bring_up_again(self) -> None:
        """End the supervisor as SIGKILL does; return when its services have ended and another one has its own up.

        It asks the system clock anew.
        """
        up, host = self._up, self._host
        up.lost = True
        self._network.detach(up.bus.session)
        up.working.cancel()
        await asyncio.wait({up.working})
        up.supervisor.abandon()
        for name, count in up.supervisor.restarts.items():
            self._restarts[name] += count
        processes = list(host.processes.values())
        for process in processes:  # their stdin has ended
            self._loop.call_later(float(host.random.uniform(0.0, NOTICED)), process.terminate)
        while any(process.pid is not None for process in processes):  # noqa: ASYNC110 - time is free here
            await asyncio.sleep(AGAIN)
        before = host.clock.now()
        host.clock = Clock(self.plan.speed)
        self.invariants.on_clock(host.clock.now() - before)
        while True:
            self._bring_up()
            up = self._up
            waiting: asyncio.Future[Any] = asyncio.create_task(up.ready.wait())
            await asyncio.wait({waiting, up.supervisor.failure}, return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            if up.ready.is_set():
                return
            self._say(f"not started: {up.supervisor.failure.exception()}")  # somebody tries once more
            up.lost = True
            up.working.cancel()
            await asyncio.wait({up.working})
            await up.supervisor.stop()
            self._network.detach(up.bus.session)

    async def _look_on(self, playing: asyncio.Task[None]) -> None:
        """Return when the run is over, or cannot begin, or something broke that must hold."""
        deadline = self._loop.time() + self._limit
        while not playing.done() and self._loop.time() < deadline:
            up = self._up
            anything: set[asyncio.Future[Any]] = {playing, up.working, up.supervisor.failure}
            await asyncio.wait(anything, timeout=LOOK,
                               return_when=asyncio.FIRST_COMPLETED)
            self.invariants.look()
            if self.invariants.broken or (up is self._up and not up.lost and (
                    up.working.done() or up.supervisor.failure.done())):
                return
            if up.lost:
                await asyncio.sleep(LOOK)

    def _say(self, line: str) -> None:
        self._tell(f"{self._loop.time():9.3f} s  {line}")

    async def _play(self) -> None:
        """Wait for the end of the task, and for what still falls then; or for nobody to start it again."""
        await self._up.ready.wait()
        making = asyncio.create_task(self._misfortune.run())
        await self._visited()
        while not self._ended.is_set() and not self.outcome.left:
            await self._ended.wait()
        self._over = True
        self.outcome.seconds = self._loop.time()
        making.cancel()
        await asyncio.wait({making})
        self._network.find_router()
        await asyncio.sleep(SETTLE)

    def _leave(self) -> None:
        """Take note that whoever ended motion has gone away: the run is over, unless somebody else started it."""
        if self.invariants.ended_by_person:
            self.outcome.left = True
            self._ended.set()

    async def _visited(self) -> None:
        """Return when the visitor has seen what there was to see."""
        if self._visit is None:
            return
        host = self._host
        session = self._network.attach(contextvars.copy_context(), VISITOR)
        bus = SimulatedBus(session, VISITOR, self.cell.name, host.clock, host.requests)
        try:
            await self._visit(bus)
        except Exception as error:
            self._failed = error
            raise
        finally:
            await bus.close()
            session.close()

    def _judge(self) -> None:
        """Take down what the task said last."""
        outcome, told = self.outcome, self._last_status
        status = decode(self._status.message, told.payload) if told else TaskStatus()
        outcome.done, outcome.total = status.done, status.total
        self.invariants.look()
        self.invariants.on_end(status.done, status.state)
        if self.invariants.broken:
            outcome.state, outcome.message = "BROKEN", self.invariants.broken[0]
        if outcome.state:
            return
        outcome.state, outcome.message = status.state, status.message
        if outcome.left:
            outcome.state, outcome.message = LEFT, "as a person left it"
            return
        if status.state not in ENDED:
            outcome.state, outcome.seconds = "NOT ENDED", self._loop.time()
            outcome.message = f"{status.state} {status.message}".strip()

    def _on_put(self, session: SimulatedSession, sample: RawSample) -> None:
        self.outcome.messages += 1
        if self._hash is not None:
            self._hash.update(
                b"%.9f %d %s" % (self._loop.time(), len(sample.payload), sample.key.encode())
                + (sample.attachment or b"")
            )
            self._hash.update(sample.payload)
        if self._trace is not None:
            self._trace.add(sample, self._loop.wall_ns() - self._loop.stepped_ns)
        if session.name in STRANGERS:
            return
        self.invariants.on_put(session.name, session.life, sample, parted=session.links > 0)
        if sample.key == self._status_key and not self._over and sample != self._last_status:
            self._last_status = sample
            if decode(self._status.message, sample.payload).state in ENDED:
                self._ended.set()
            else:
                self._ended.clear()

    async def _clear(self, playing: asyncio.Task[None], host: SimulatedHost) -> None:
        """Leave nothing behind that runs."""
        self._tell = lambda line: None
        up = self._up
        for task in (playing, up.working):
            task.cancel()
        await asyncio.wait({playing, up.working})
        with contextlib.suppress(Exception):
            await up.supervisor.stop()
        await up.bus.close()
        up.bus.session.close()
        if left := host.clear_away():
            await asyncio.wait(left, timeout=CLEARING)
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()
        await asyncio.sleep(1.0)


@contextlib.contextmanager
def _state_folder() -> Iterator[None]:
    """A folder in memory in which simulated hardware keeps how it stands."""
    before = os.environ.get(STATE_VARIABLE)
    shared = Path("/dev/shm")  # noqa: S108 - where there is one, else on disk
    folder = tempfile.mkdtemp(prefix="zencell-", dir=shared if os.access(shared, os.W_OK) else None)
    os.environ[STATE_VARIABLE] = folder
    try:
        yield
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if before is None:
            os.environ.pop(STATE_VARIABLE, None)
        else:
            os.environ[STATE_VARIABLE] = before


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """No log lines of this process, which are those of its processes; and garbage is left for later."""
    root = logging.getLogger()
    handlers, root.handlers[:] = list(root.handlers), [logging.NullHandler()]
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        root.handlers[:] = handlers
        if collecting:
            gc.enable()
            gc.collect()


FLUSH_NS = 800_000_000  # of virtual time


class Trace:
    """Writes every message once, at its virtual time."""

    def __init__(self, path: Path, about: Mapping[str, Any], own: CustomTopics) -> None:
        """Create the file.

        Args:
            path: of the file.
            about: what is recorded.
            own: what there is in the cell beside what comes with the project.

        Raises:
            RecordingError: it is there already, or cannot be written.
        """
        self._writer = RecordingWriter(path, about)
        self._kinds = own.kinds(own.topics())
        self._newness: dict[str, Newness] = {}
        self._run_known = False
        self._flushed = 0

    @property
    def messages(self) -> int:
        """How many were written."""
        return self._writer.messages

    def add(self, raw: RawSample, now: int) -> None:
        """Write a message that is put now [ns since the Unix epoch], unless it is put again."""
        origin = decode_attachment(raw.attachment)
        if origin is None or not self._newness.setdefault(raw.key, Newness()).is_new(origin):
            return
        topic = raw.key.partition("/")[2]
        if topic == topics.SUPERVISOR_STATUS.key and not self._run_known:
            self._run_known = True
            status = decode(SupervisorStatus, raw.payload)
            self._writer.describe(RUN, run_of(status))
        kind = self._kinds.get(topics.general_key(topic), "stream")
        self._writer.add(Sample(
            raw.key, raw.payload, now, message=message_of(raw.encoding), kind=kind,
            writer=origin.writer, sequence=origin.sequence, trace=origin.trace,
        ))
        if now - self._flushed > FLUSH_NS:
            self._flushed = now
            self._writer.flush()

    def close(self, reason: str) -> None:
        """Write how it ended, and the rest."""
        self._writer.close({"reason": reason, "missed": {}, "dropped": {}})
