"""One cell at a terminal: bring it up, run its task or wait for Ctrl-C, and shut it down."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from cli.session.plan import SessionPlan
from common.terminal import printable

if TYPE_CHECKING:
    from cli.session.screens import Content, Screen
    from common.messages import Interlock
    from common.supervision.supervisor import Supervisor
    from common.transport.bus import Bus
    from lab.chaos.agent import Chaos
    from recording.report.aggregator import Collector

T = TypeVar("T")

EXECUTOR = "trajectory_executor"
STATUS_TIMEOUT = 2.0  # [s] for the first motion status of the executor
START_TIMEOUT = 5.0  # [s] for the answer to the start of the task
CHECK_TIMEOUT = 10.0  # [s] for the quick check of the cell, which has a lower priority than its services
SUMMARY_TIMEOUT = 5.0  # [s] for a slow reader of the summary
UNEXPLAINED_EXIT = 3  # exit code of a task that is DONE although the simulated world has objects left


class CellSession(SessionPlan):
    """One cell, from its start to its shutdown."""

    first: Callable[[Bus], Awaitable[None]] | None = None  # runs at the terminal once the cell is up
    _supervisor: Supervisor | None = None
    _collector: Collector | None = None
    _screen: Screen | None = None
    _chaos: Chaos | None = None
    _checking: asyncio.Task[None] | None = None

    def visit(self, visit: Callable[[Bus], Awaitable[T]]) -> T:
        """Bring the cell up, and return the result of `visit`.

        Raises:
            KeyboardInterrupt: a signal ended the cell.
        """
        results: list[T] = []

        async def work(bus: Bus) -> int:
            results.append(await visit(bus))
            return 0

        if asyncio.run(self._run(work)) or not results:
            raise KeyboardInterrupt
        return results[0]

    def run_to_end(self) -> int:
        """Run the task to its end and print a summary.

        Returns:
            Exit code: 0 if the task is DONE, 1 if not, 130 after Ctrl-C, 3 if it is DONE but the simulated world has
            objects left for which the summary gives no reason.
        """
        from common.process.log import DroppingWriter
        from common.supervision.supervisor import StartFailed
        from recording.report.summary import describe

        try:
            code = asyncio.run(self._run(self._until_ended))
        except StartFailed:
            self.summary.failed = True
            self.write_summary()
            raise
        try:
            self.write_summary()
        finally:  # also when the file cannot be written
            out = DroppingWriter(sys.stdout)
            for line in describe(self.summary.as_dict(), self.aggregator.figures):
                out.put(printable(line) + "\n")
            out.flush(SUMMARY_TIMEOUT)
        return UNEXPLAINED_EXIT if code == 0 and self.summary.unexplained else code

    def stay(self) -> int:
        """Stay up until a signal, and return the exit code: 0 if the cell was up."""
        code = asyncio.run(self._run(self._until_interrupted))
        self.write_summary()
        return 0 if self.summary.ready is not None else code

    async def _run(self, work: Callable[[Bus], Awaitable[int]]) -> int:
        """Do the work in the cell and return its exit code.

        The state of simulated hardware is deleted with the cell; interlocks of operators persist.
        """
        from common.atomic_file import RUNTIME_VARIABLE, STATE_VARIABLE, state_folder, world_file
        from common.transport.endpoint import DEFAULT_DOMAIN

        if os.environ.get(STATE_VARIABLE):
            if self._simulated and (world := world_file(self.cell.name)) and world.exists():
                self.summary.continued = str(world)
            return await self._supervised(work)
        folder = state_folder()
        if self._simulated and not self.launch.connect and self.launch.domain != DEFAULT_DOMAIN:
            folder /= f"domain-{self.launch.domain}"  # several simulated robots may run on this host
        with tempfile.TemporaryDirectory(prefix="zencell-") as until_end:
            extra = {**self.launch.extra, STATE_VARIABLE: str(folder), RUNTIME_VARIABLE: until_end}
            self.launch = replace(self.launch, extra=extra)
            return await self._supervised(work)

    async def _supervised(self, work: Callable[[Bus], Awaitable[int]]) -> int:
        from common.supervision.preloaded import Preloaded

        preloaded = Preloaded(self.launch.environment())  # its imports overlap with ours
        from common.supervision.child import Child
        from common.supervision.lifecycle import Interrupted, Interrupts, run_cell
        from common.supervision.supervisor import Supervisor

        interrupts = Interrupts()
        interrupts.install()
        early: list[tuple[str, str]] = []

        def show(name: str, text: str) -> None:
            if self._screen is None:
                early.append((name, text))
            else:
                self._screen.line(name, text)

        await asyncio.to_thread(preloaded.wait_ready)
        self._supervisor = Supervisor(self.cell, self.launch, show, self._watchers, partial(Child, preloaded=preloaded))
        self._supervisor.start()  # before the rest of our imports, which take as long as those of the services
        try:
            self._open_screen(early)
            return await run_cell(self.cell, self.launch, self._supervisor, interrupts, work, self._prepare)
        except Interrupted:
            return 128 + (interrupts.signal or signal.SIGINT)
        finally:
            if self._checking:
                self._checking.cancel()
            if self._collector:
                self._collector.read_truth()
            self.summary.restarts = self._supervisor.restarts
            self.summary.chaos = self._chaos.as_dicts() if self._chaos else None
            preloaded.close()
            if self._screen:
                self._screen.close()

    def _open_screen(self, early: list[tuple[str, str]]) -> None:
        from cli.session.screens import ScreenHandler, open_screen

        self._screen = open_screen(self._content, log_json=self.launch.log_json, plain=self.first is not None)
        for name, text in early:
            self._screen.line(name, text)
        root = logging.getLogger()
        root.addHandler(ScreenHandler(self._screen, log_json=self.launch.log_json))
        root.setLevel(logging.INFO)

    def _content(self) -> Content:
        from cli.session.screens import Content

        assert self._supervisor is not None
        statuses = self._supervisor.statuses
        if self._collector is None:
            return Content(statuses, {}, self.aggregator.progress)
        rates = {status.name: self._collector.rates.busiest_of(status.name) for status in statuses}
        return Content(statuses, {name: rate for name, rate in rates.items() if rate}, self.aggregator.progress)

    def _prepare(self, bus: Bus) -> None:
        from recording.report.aggregator import Collector

        assert self._screen is not None
        self._collector = Collector(bus, self.aggregator, self.began, self._screen.progress)

    async def _until_ended(self, bus: Bus) -> int:
        from common.supervision.lifecycle import run_with_background

        collector = await self._on_up(bus)
        await self._start_task(bus)

        async def end() -> None:
            if self.first is not None:
                await self.first(bus)
            await collector.ended.wait()
            await collector.settle()

        await run_with_background(self._inject_faults(), run_with_background(collector.run(), end()))
        if self._checking is not None:  # its warnings may explain a short run
            await asyncio.wait({self._checking}, timeout=CHECK_TIMEOUT)
        return 0 if self.summary.state == "DONE" else 1

    async def _start_task(self, bus: Bus) -> None:
        """Start the task if it does not start by itself; `run` also releases interlocks of a simulated robot."""
        from common import topics
        from common.client.joining import operator_name
        from common.client.task import send_task_command

        interlocks = await self._persisted_interlocks(bus)
        if not self._simulated:
            self._report(interlocks)
        if (self._simulated and interlocks) or (not self.cell.run.autostart and not interlocks):
            newest = max((interlock.since for interlock in interlocks), default=0)  # a newer stop is not released
            await send_task_command(
                bus.client(topics.TASK_COMMAND), "start", operator_name(), override=bool(interlocks),
                acknowledged=newest, timeout=START_TIMEOUT)
            for interlock in interlocks:
                self._note(f"Released: {self.cell.name} was {interlock.description}")

    async def _until_interrupted(self, bus: Bus) -> int:
        from common.supervision.lifecycle import run_with_background
        from common.transport.endpoint import endpoint_of

        collector = await self._on_up(bus)
        endpoint = endpoint_of(None if self.launch.connect else self.launch.domain, self.launch.connect)
        took = f"{self.summary.ready:.1f} s"
        self._note(f"{self.cell.name} is up at {endpoint} after {took}. To see all its messages:")
        self._note(zenoh_cli_line(endpoint, self.cell.name))
        self._report(await self._persisted_interlocks(bus))
        await run_with_background(self._inject_faults(), collector.run())
        return 0

    async def _persisted_interlocks(self, bus: Bus) -> list[Interlock]:
        """Return stops and holds of operators from before the cell came up; report a reduced speed."""
        from common import topics
        from common.messages import SELF_RELEASING

        if not any(entry.kind == EXECUTOR for entry in self.cell.services.values()):
            return []  # it runs on another host, or the cell has no arm
        reader, motion = bus.reader(topics.MOTION_STATUS), None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(STATUS_TIMEOUT):
                motion = reader.latest or await reader.next()
        if motion is None:
            return []
        if motion.speed_scaling < 1:
            self._note(f"Motions run at {100 * motion.speed_scaling:.0f} % of their speed; for full speed: "
                       f"`zencell param set services.{EXECUTOR}.speed_scaling=1`")
        return [interlock for interlock in motion.interlocks if interlock.by not in SELF_RELEASING]

    def _report(self, interlocks: list[Interlock]) -> None:
        for interlock in interlocks:
            command = "start" if interlock.kind == "stopped" else "resume"
            self._note(f"{self.cell.name} is {interlock.description}: `zencell task {command}` lets it continue")

    def _note(self, line: str) -> None:
        assert self._screen is not None
        self._screen.note(line)

    async def _check_cell(self) -> None:
        """Show the warnings of a quick check of the cell."""
        from tools.check.cell import QuickCheckFailed, warnings_in_subprocess

        try:
            for found in await warnings_in_subprocess(self.cell, self.launch.environment()):
                self._note(f"{found.severity}: {printable(found.line)}")
        except QuickCheckFailed as error:
            self._note(f"warning: {error}")

    async def _inject_faults(self) -> None:
        if self._chaos is not None:
            await self._chaos.run()

    async def _on_up(self, bus: Bus) -> Collector:
        assert self._collector is not None
        self.summary.ready = time.monotonic() - self.began
        if self._page:
            self._note(f"Open {self._page.url}")
        self._checking = asyncio.create_task(self._check_cell(), name="check")
        if self._faults is not None:
            from lab.chaos.agent import create_chaos, keys_of

            assert self._supervisor is not None
            seed, per_minute, until_ended = self._faults
            known = keys_of(await bus.owners(), [entry.name for entry in self.cell.services.values()])
            self._chaos = create_chaos(
                bus, self.cell, self._supervisor, known, seed, per_minute, until_ended=until_ended)
        return self._collector


def zenoh_cli_line(endpoint: str, cell: str) -> str:
    """Return a command line that shows all messages of a cell with zenoh-cli."""
    line = "{key} {value}"
    return f"zenoh --mode client --connect {endpoint} subscribe -k '{cell}/**' --decoder msgpack --line '{line}'"
