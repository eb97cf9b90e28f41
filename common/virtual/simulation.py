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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from common.application import find_application
from common.clock import Clock
from common.config import Cell
from common.messages import TaskStatus
from common.sim.standing import STATE_VARIABLE
from common.sources import drawn_from
from common.supervision.launch import Launch
from common.supervision.operation import supervise
from common.supervision.supervisor import Supervisor
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.session import RawSample
from common.virtual.loop import VirtualLoop
from common.virtual.network import FAIR, VirtualNetwork, VirtualSession
from common.virtual.process import Host, VirtualBus, VirtualProcess

LIMIT = 900.0  # [s] virtual time in which the task has to end
SETTLE = 2.0  # [s] of virtual time for what still falls when the task has ended
CLEARING = 30.0  # [s] of virtual time for what was cut off to come to its end
SUPERVISOR, HOST = "supervisor", "simulated"
ENDED = ("DONE", "ERROR")
LEFT_OUT = ("viewer",)  # a page in a browser has no place on a virtual clock

log = logging.getLogger(__name__)


@dataclass
class Outcome:
    """What became of one seed. Times are virtual [s], but for `cpu_seconds`."""

    seed: int
    state: str = ""
    message: str = ""
    done: int = 0
    total: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    messages: int = 0
    digest: str = ""  # of the message log: time, key, payload and attachment of every message
    restarts: dict[str, int] = field(default_factory=dict)
    crashes: list[str] = field(default_factory=list)  # of services by themselves
    requests: Counter[str] = field(default_factory=Counter)  # by outcome

    @property
    def ok(self) -> bool:
        """Whether the task ended DONE."""
        return self.state == "DONE"


class Simulation:
    """One run of a cell under one seed."""

    def __init__(self, cell: Cell, seed: int, *, limit: float = LIMIT, digest: bool = False) -> None:
        """Prepare a run.

        Args:
            cell: resolved; its viewer is left out.
            seed: decides everything that is left open.
            limit: virtual time in which the task has to end [s].
            digest: whether a digest of the message log is made.
        """
        kept = {key: entry for key, entry in cell.services.items() if entry.name not in LEFT_OUT}
        self.cell = cell.model_copy(update={"services": kept})
        self.outcome = Outcome(seed)
        self._limit = limit
        self._hash = hashlib.blake2b(digest_size=16) if digest else None
        self._status = find_application(cell.application).status
        self._status_key = f"{cell.name}/{self._status.key}"
        self._last_status: RawSample | None = None
        self._ended = asyncio.Event()
        self._loop = VirtualLoop(seed)
        self._network = VirtualNetwork(self._loop, seed, FAIR)
        self._network.on_put = self._on_put

    def run(self) -> Outcome:
        """What became of it."""
        began = time.process_time()
        with drawn_from(self._loop), _state_folder(), _quiet():
            try:
                self._loop.run_until_complete(self._run())
            finally:
                self._loop.close()
        if self._hash is not None:
            self.outcome.digest = self._hash.hexdigest()
        self.outcome.cpu_seconds = time.process_time() - began
        return self.outcome

    async def _run(self) -> None:
        outcome, clock = self.outcome, Clock()
        host = Host(self._loop, self._network, self.cell, clock, np.random.default_rng([outcome.seed, 4]))
        entries = {entry.name: entry for entry in self.cell.services.values()}

        def make_child(name: str, _command: object, _environment: object, on_line: Callable[[str, str], None]) -> Any:
            return VirtualProcess(host, entries[name], on_line)

        launch = Launch(cell=self.cell.name, connect="tcp/127.0.0.1:7447", clock=clock)
        session = self._network.attach(contextvars.copy_context())
        bus = VirtualBus(session, SUPERVISOR, self.cell.name, clock, host.requests)
        supervisor = Supervisor(self.cell, launch, lambda name, line: None, make_child=make_child)
        supervisor.begin()
        working = asyncio.create_task(supervise(bus, self.cell, launch, supervisor, self._work, host=HOST))
        try:
            await asyncio.wait({working, supervisor.failure}, timeout=self._limit,
                               return_when=asyncio.FIRST_COMPLETED)
            if supervisor.failure.done():
                outcome.state, outcome.message = "NOT STARTED", str(supervisor.failure.exception())
            elif working.done() and not working.cancelled() and (error := working.exception()) is not None:
                outcome.state, outcome.message = "NOT STARTED", f"{type(error).__name__}: {error}"
            self._judge()
        finally:
            outcome.restarts = {name: count for name, count in supervisor.restarts.items() if count}
            outcome.crashes, outcome.requests = host.crashes, host.requests.outcomes
            self._network.on_put = lambda session, sample: None  # what comes now is no part of the run
            await self._clear(working, supervisor, bus, host)

    async def _work(self, bus: Bus) -> None:
        """Wait for the end of the task, and for what still falls then."""
        await self._ended.wait()
        self.outcome.seconds = self._loop.time()
        await asyncio.sleep(SETTLE)

    def _judge(self) -> None:
        """Take down what the task said last."""
        outcome, told = self.outcome, self._last_status
        status = decode(self._status.message, told.payload) if told else TaskStatus()
        outcome.done, outcome.total = status.done, status.total
        if outcome.state:
            return
        outcome.state, outcome.message = status.state, status.message
        if status.state not in ENDED:
            outcome.state, outcome.seconds = "NOT ENDED", self._loop.time()
            outcome.message = f"{status.state} {status.message}".strip()

    def _on_put(self, session: VirtualSession, sample: RawSample) -> None:
        self.outcome.messages += 1
        if self._hash is not None:
            self._hash.update(
                b"%.9f %d %s" % (self._loop.time(), len(sample.payload), sample.key.encode())
                + (sample.attachment or b"")
            )
            self._hash.update(sample.payload)
        if sample.key == self._status_key and (self._last_status is None or sample != self._last_status):
            self._last_status = sample
            if decode(self._status.message, sample.payload).state in ENDED:
                self._ended.set()

    async def _clear(self, working: asyncio.Task[None], supervisor: Supervisor, bus: VirtualBus, host: Host) -> None:
        """Leave nothing behind that runs."""
        working.cancel()
        await asyncio.wait({working})
        with contextlib.suppress(Exception):
            await supervisor.stop()
        await bus.close()
        bus.session.close()
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
    """No log of this process, and no garbage collection in the middle of anything."""
    logging.disable(logging.NOTSET)
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
