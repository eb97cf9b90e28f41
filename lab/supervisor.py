"""The supervisor of a simulated cell, which can be killed and started again with all its services."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from common import topics
from common.clock import Clock
from common.supervision.launch import Launch
from common.supervision.lifecycle import supervise
from common.supervision.supervisor import Supervisor
from common.transport.bus import Bus
from lab.processes import SimulatedBus, SimulatedHost, SimulatedProcess

SUPERVISOR, HOST = "supervisor", "simulated"
NOTICED = 1.0  # [s] within which a process notices that its supervisor is gone
POLL = 0.1  # [s] between checks of a condition


@dataclass
class Instance:
    """One life of the supervisor."""

    supervisor: Supervisor
    bus: SimulatedBus
    ready: asyncio.Event  # all services are up
    working: asyncio.Task[None]
    lost: bool = False

    @property
    def failure(self) -> BaseException | None:
        """Why the cell did not come up, or why the supervisor failed; None if it did not."""
        if self.supervisor.failure.done():
            return self.supervisor.failure.exception()
        if self.working.done() and not self.working.cancelled():
            return self.working.exception()
        return None


class SimulatedSupervisor:
    """Starts the services of a cell on a simulated host."""

    def __init__(
        self, host: SimulatedHost, speed: float, log: Callable[[str], None], on_clock: Callable[[float], None]
    ) -> None:
        """Prepare without starting anything.

        Args:
            host: runs the processes.
            speed: cell time per wall time.
            log: called with each log line.
            on_clock: called with the step of cell time [s] when the cell is started again.
        """
        self._host, self._speed, self._log, self._on_clock = host, speed, log, on_clock
        self._restarts: Counter[str] = Counter()  # of earlier lives
        self.current = self._start()

    @property
    def restarts(self) -> dict[str, int]:
        """Restarts of services in all lives."""
        return dict(self._restarts + Counter(self.current.supervisor.restarts))

    def _start(self) -> Instance:
        """Start a supervisor, which starts all services."""
        host, clock, cell = self._host, self._host.clock, self._host.cell
        entries = {entry.name: entry for entry in cell.services.values()}

        def make_child(name: str, _command: object, _environment: object, on_line: Callable[[str, str], None]) -> Any:
            return SimulatedProcess(host, entries[name], on_line)

        launch = Launch(cell=cell.name, connect="tcp/127.0.0.1:7447", clock=clock)
        host.started += 1
        session = host.network.attach(contextvars.copy_context(), SUPERVISOR, host.started)
        bus = SimulatedBus(session, SUPERVISOR, cell.name, clock, host.requests)
        supervisor = Supervisor(cell, launch, lambda name, line: self._log(line), make_child=make_child)
        # Log lines are published only while there is a subscriber.
        bus.raw_subscriber(f"{cell.name}/{topics.LOG.expression}", lambda sample: None)
        supervisor.start()
        ready = asyncio.Event()

        async def work(_bus: Bus) -> None:
            ready.set()
            await asyncio.Event().wait()

        working = asyncio.create_task(supervise(bus, cell, launch, supervisor, work, host=HOST))
        return Instance(supervisor, bus, ready, working)

    async def restart(self) -> None:
        """Kill the supervisor; return when its services have ended and a new one has started them again.

        The new one reads the system clock again.
        """
        old, host = self.current, self._host
        old.lost = True
        host.network.detach(old.bus.session)
        old.working.cancel()
        await asyncio.wait({old.working})
        old.supervisor.abandon()
        self._restarts += Counter(old.supervisor.restarts)
        processes = list(host.processes.values())
        for process in processes:  # their stdin has reached its end
            host.loop.call_later(float(host.random.uniform(0.0, NOTICED)), process.terminate)
        while any(process.pid is not None for process in processes):  # noqa: ASYNC110 - time is free here
            await asyncio.sleep(POLL)
        before = host.clock.now()
        host.clock = Clock(self._speed)
        self._on_clock(host.clock.now() - before)
        while True:
            new = self.current = self._start()
            ready: asyncio.Future[Any] = asyncio.create_task(new.ready.wait())
            await asyncio.wait({ready, new.supervisor.failure}, return_when=asyncio.FIRST_COMPLETED)
            ready.cancel()
            if new.ready.is_set():
                return
            self._log(f"not started: {new.supervisor.failure.exception()}")  # the user tries again
            new.lost = True
            new.working.cancel()
            await asyncio.wait({new.working})
            await new.supervisor.stop()
            host.network.detach(new.bus.session)

    async def stop(self) -> None:
        """Stop the current supervisor and its services."""
        current = self.current
        current.working.cancel()
        await asyncio.wait({current.working})
        with contextlib.suppress(Exception):
            await current.supervisor.stop()
        await current.bus.close()
        current.bus.session.close()
