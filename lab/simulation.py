"""One complete cell from its start to the end of its task, in this process and on virtual time."""

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
from collections.abc import Callable, Collection, Coroutine, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from common.application import find_application
from common.atomic_file import STATE_VARIABLE
from common.clock import Clock
from common.config import Cell
from common.messages import TaskStatus
from common.time_source import use_time_source
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.session import RawSample
from lab.doubles import is_double
from lab.fault_injector import STRANGER, FaultInjector
from lab.faults import FaultPlan, make_plan
from lab.invariants import Invariants
from lab.loop import VirtualTimeLoop
from lab.network import SimulatedNetwork, SimulatedSession
from lab.observers import Trace, observe_set_points, with_observed_arm
from lab.processes import RequestLog, SimulatedBus, SimulatedHost
from lab.supervisor import SimulatedSupervisor

LIMIT = 300.0  # [s] of virtual time in which the task must end
CHECK_PERIOD = 0.5  # [s] of virtual time between checks of open requests
SETTLE = 2.0  # [s] of virtual time for falling objects after the task has ended
CLEANUP = 30.0  # [s] of virtual time for killed processes to unwind
VISITOR = "visitor"
UNCHECKED = (VISITOR, STRANGER)  # may publish anything, malformed messages included
ENDED, LEFT = ("DONE", "ERROR"), "LEFT"
SOONER = 0.5  # factor on the time of faults in a cell with doubles, whose task takes half as long
OPERATOR_FAULTS = ("operator", "operator stop", "speed change", "late start", "abandoned goal", "takeover")
LEFT_OUT = ("viewer",)  # a page in a browser cannot run on virtual time

Visit = Callable[[Bus], Coroutine[Any, Any, None]]


@dataclass
class Outcome:
    """Result of one seed. Times are virtual [s], except `cpu_seconds`."""

    seed: int
    state: str = ""
    message: str = ""
    done: int = 0
    total: int = 0
    left: bool = False  # an operator stopped the robot and left
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    messages: int = 0
    digest: str = ""  # of the message log: time, key, payload and attachment of every message
    restarts: dict[str, int] = field(default_factory=dict)
    crashes: list[str] = field(default_factory=list)  # of services, not injected
    requests: Counter[str] = field(default_factory=Counter)  # by outcome
    faults: Counter[str] = field(default_factory=Counter)  # injected, by kind
    checked: Counter[str] = field(default_factory=Counter)  # checks by invariant
    broken: list[str] = field(default_factory=list)  # violated invariants, with time and detail

    @property
    def ok(self) -> bool:
        """Whether the task ended DONE, or an operator stopped the robot and left."""
        return self.state in ("DONE", LEFT)


class Simulation:
    """One run of a cell under one seed."""

    def __init__(
        self, cell: Cell, seed: int, *, faults: bool = False, limit: float = LIMIT, digest: bool = False,
        trace: Trace | None = None, log: Callable[[str], None] = lambda line: None, visit: Visit | None = None,
        without: Collection[str] = (),
    ) -> None:
        """Prepare a run.

        Args:
            cell: resolved; its viewer is left out.
            seed: decides everything that is left open.
            faults: whether faults are injected.
            limit: virtual time in which the task must end [s].
            digest: whether to compute a digest of the message log.
            trace: records all messages.
            log: called with each log line and each fault.
            visit: coroutine that runs once the cell is ready; the run ends with the task after it. Its messages are not
                checked.
            without: kinds of faults to leave out.

        Raises:
            ConfigError: the cell has a real arm or cannot be simulated.
        """
        services = {key: entry for key, entry in cell.services.items() if not {entry.name, entry.kind} & {*LEFT_OUT}}
        self.cell = with_observed_arm(cell.model_copy(update={"services": services}))
        names = [entry.name for entry in services.values()]
        doubled = any(is_double(entry) for entry in services.values())
        self.plan = make_plan(seed, names, SOONER if doubled else 1.0, without) if faults else FaultPlan()
        if cell.robots:  # the operator model knows one arm
            self.plan = replace(self.plan, faults=tuple(
                fault for fault in self.plan.faults if fault.kind not in OPERATOR_FAULTS))
        self.outcome = Outcome(seed)
        self._limit, self._trace, self._log, self._visit = limit, trace, log, visit
        self._visit_error: BaseException | None = None
        self._hash = hashlib.blake2b(digest_size=16) if digest else None
        self._status = find_application(cell.application).status
        self._status_key = f"{cell.name}/{self._status.key}"
        self._last_status: RawSample | None = None
        self._ended = asyncio.Event()
        self._over = False  # ignore the task's status from now on: an operator may have started it again
        self._loop = VirtualTimeLoop(seed, shuffled=self.plan.shuffled)
        self._network = SimulatedNetwork(self._loop, seed, self.plan.links)
        self._network.on_put = self._on_put
        requests = RequestLog()
        self.invariants = Invariants(self.cell, requests, self._loop.time)
        self._network.on_subscribe = lambda session, key: self.invariants.on_subscribe(session.name, key)
        self._host = SimulatedHost(
            self._loop, self._network, self.cell, Clock(self.plan.speed), np.random.default_rng([seed, 4]), requests,
            skews=dict(self.plan.skews),
        )

    def run(self) -> Outcome:
        """Run the cell and return the outcome; an exception of the visit is raised."""
        started_at = time.process_time()
        with use_time_source(self._loop), observe_set_points(self.invariants.on_set_point), _state_folder(), _quiet():
            try:
                self._loop.run_until_complete(self._run())
            finally:
                self._loop.close()
        if self._hash is not None:
            self.outcome.digest = self._hash.hexdigest()
        self.outcome.cpu_seconds = time.process_time() - started_at
        if self._visit_error is not None:
            raise self._visit_error
        return self.outcome

    def kill(self, name: str) -> None:
        """Kill a process of the cell, as SIGKILL does."""
        self._host.processes[name].kill()

    def pause(self, name: str, seconds: float) -> None:
        """Give a process no processor for a time [s]: it runs no timers and receives no messages until then."""
        self._host.processes[name].incarnation.paused_until = self._loop.time() + seconds

    def lose_router(self, seconds: float) -> None:
        """Cut all links for a time [s], as while the router restarts."""
        self._network.lose_router()
        self._loop.call_later(seconds, self._network.restore_router)

    async def _run(self) -> None:
        outcome, host = self.outcome, self._host
        host.clock = Clock(self.plan.speed)
        injector = FaultInjector(host, self.plan, outcome.seed, self._status, self._say)
        supervisor = SimulatedSupervisor(host, self.plan.speed, self._say, self.invariants.on_clock)
        injector.lose_supervisor, injector.operators.on_leave = supervisor.restart, self._on_leave
        playing = asyncio.create_task(self._play(supervisor, injector))
        try:
            await self._watch(supervisor, playing)
            if (failure := supervisor.current.failure) is not None:
                known = supervisor.current.supervisor.failure.done()
                outcome.state = "NOT STARTED"
                outcome.message = str(failure) if known else f"{type(failure).__name__}: {failure}"
            self._conclude()
        finally:
            outcome.restarts = supervisor.restarts
            outcome.crashes, outcome.requests = host.crashes, host.requests.outcomes
            outcome.faults = injector.injected + self._network.counted
            outcome.broken, outcome.checked = self.invariants.broken, self.invariants.checked
            self.invariants.finished = True
            self._network.on_put = lambda session, sample: None
            self._log = lambda line: None
            await self._clean_up(supervisor, playing)

    async def _watch(self, supervisor: SimulatedSupervisor, playing: asyncio.Task[None]) -> None:
        """Return when the run is over, cannot start, or an invariant is violated."""
        deadline = self._loop.time() + self._limit
        while not playing.done() and self._loop.time() < deadline:
            current = supervisor.current
            ends: set[asyncio.Future[Any]] = {playing, current.working, current.supervisor.failure}
            await asyncio.wait(ends, timeout=CHECK_PERIOD, return_when=asyncio.FIRST_COMPLETED)
            self.invariants.check_requests()
            if self.invariants.broken or (current is supervisor.current and not current.lost and (
                    current.working.done() or current.supervisor.failure.done())):
                return
            if current.lost:
                await asyncio.sleep(CHECK_PERIOD)

    def _say(self, line: str) -> None:
        self._log(f"{self._loop.time():9.3f} s  {line}")

    async def _play(self, supervisor: SimulatedSupervisor, injector: FaultInjector) -> None:
        """Wait for the end of the task and for objects to settle, or for an operator to leave."""
        await supervisor.current.ready.wait()
        injecting = asyncio.create_task(injector.run())
        await self._run_visit()
        while not self._ended.is_set() and not self.outcome.left:
            await self._ended.wait()
        self._over = True
        self.outcome.seconds = self._loop.time()
        injecting.cancel()
        await asyncio.wait({injecting})
        self._network.restore_router()
        await asyncio.sleep(SETTLE)

    def _on_leave(self) -> None:
        """End the run because an operator stopped the robot and left, unless another one started it again."""
        if self.invariants.stopped_by_operator:
            self.outcome.left = True
            self._ended.set()

    async def _run_visit(self) -> None:
        if self._visit is None:
            return
        host = self._host
        session = self._network.attach(contextvars.copy_context(), VISITOR)
        bus = SimulatedBus(session, VISITOR, self.cell.name, host.clock, host.requests)
        try:
            await self._visit(bus)
        except asyncio.CancelledError:
            raise
        except BaseException as error:  # a failed assertion of pytest is no Exception
            self._visit_error = error
            raise
        finally:
            await bus.close()
            session.close()

    def _conclude(self) -> None:
        """Fill the outcome from the task's last status and the final checks."""
        outcome, last = self.outcome, self._last_status
        status = decode(self._status.message, last.payload) if last else TaskStatus()
        outcome.done, outcome.total = status.done, status.total
        self.invariants.check_requests()
        self.invariants.on_end(status.done, status.state)
        if self.invariants.broken:
            outcome.state, outcome.message = "BROKEN", self.invariants.broken[0]
        if outcome.state:
            return
        outcome.state, outcome.message = status.state, status.message
        if outcome.left:
            outcome.state, outcome.message = LEFT, "an operator stopped the robot and left"
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
        if session.name in UNCHECKED:
            return
        self.invariants.on_put(session.name, session.instance, sample, isolated=session.cuts > 0)
        if sample.key == self._status_key and not self._over and sample != self._last_status:
            self._last_status = sample
            if decode(self._status.message, sample.payload).state in ENDED:
                self._ended.set()
            else:
                self._ended.clear()

    async def _clean_up(self, supervisor: SimulatedSupervisor, playing: asyncio.Task[None]) -> None:
        """End everything that still runs."""
        playing.cancel()
        supervisor.current.working.cancel()
        await asyncio.wait({playing})
        await supervisor.stop()
        if killed := self._host.clean_up():
            await asyncio.wait(killed, timeout=CLEANUP)
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()
        await asyncio.sleep(1.0)


@contextlib.contextmanager
def _state_folder() -> Iterator[None]:
    """Let simulated hardware persist its state in a temporary folder, in memory if possible."""
    before = os.environ.get(STATE_VARIABLE)
    shared = Path("/dev/shm")  # noqa: S108 - used where it exists
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
    """Silence this process's root logger, to which simulated processes log, and defer garbage collection."""
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
