"""One cell that is up at a terminal, from what was asked for to its end."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from cli.session.interlocks import persisted_interlocks
from common.supervision.multi_host import HostOptions
from common.terminal import printable

if TYPE_CHECKING:
    from cli.session.live_table import Content
    from cli.session.screens import Screen
    from common.config import Cell
    from common.messages import Interlock
    from common.supervision.supervisor import Supervisor
    from common.transport.bus import Bus
    from lab.chaos.agent import Chaos
    from page.address import PageAddress
    from recording.report.aggregator import Collector

T = TypeVar("T")

START_REQUEST_TIMEOUT = 5.0  # [s]
DOUBTS_TIMEOUT = 10.0  # [s] for the quick look at the cell, which is nicer than its services
LAST_WORDS = 5.0  # [s] for whoever is slow to read what became of a run
LEFT = 3  # exit code


class Disturbance(NamedTuple):
    """Faults that were asked for."""

    seed: int
    per_minute: float
    until_ended: bool  # rather than without end


class CellSession:
    """One bring-up, as a person asked for it."""

    def __init__(
        self, cell: str, overrides: Sequence[str] | None = None, *, world: str | None = None, seed: int | None = None,
        speed: float = 1.0, domain: str | None = None, connect: str | None = None, no_viewer: bool = False,
        summary: str | None = None, log_json: bool = False, share: HostOptions | None = None,
    ) -> None:
        """Check everything that was asked for; nothing is started yet.

        Args:
            cell: name or path of its file.
            overrides: as given to `--set`.
            world: another one, by name or path.
            seed: of everything random.
            speed: cell time per wall time.
            domain: where, as given to `--domain`.
            connect: where, as given to `--connect`.
            no_viewer: without the operator's page.
            summary: file for the figures of a run.
            log_json: log lines are JSON objects.
            share: of this host in the cell.

        Raises:
            ConfigError, UnknownName: one line naming the option, the value and the choices.
        """
        from common.application import find_application
        from common.config import expanded, load_cell
        from common.errors import ConfigError
        from common.supervision.launch import (
            Launch,
            clock_at_speed,
            process_start_time,
            require_free_port,
            require_modules,
            router_location,
        )
        from common.transport.endpoint import endpoint_of
        from recording.report.aggregator import RunAggregator
        from security.page_tokens import VIEWER
        from security.requiring import require_secured, with_near
        from tools.check.cell import require_safe

        self.began = process_start_time()
        self.file = Path(summary) if summary else None
        if self.file and not self.file.absolute().parent.is_dir():
            raise ConfigError("--summary", summary, "is in a folder that does not exist")
        if self.file and self.file.is_dir():
            raise ConfigError("--summary", summary, "is a folder")
        share = share or HostOptions()
        number, endpoint = router_location(domain, connect)
        self.launch = share.linked(Launch(
            cell=cell, overrides=tuple(expanded(overrides or ())), world=world, seed=seed, domain=number,
            connect=endpoint, log_json=log_json, clock=clock_at_speed(speed, share.epoch(speed)),
        ))
        loaded = load_cell(cell, self.launch.overrides, world=world, seed=self.launch.seed)
        if no_viewer:
            kept = {name: entry for name, entry in loaded.services.items() if entry.kind != VIEWER}
            loaded = loaded.model_copy(update={"services": kept})
        self.cell: Cell = loaded
        self.fold = RunAggregator(
            loaded.name, find_application(loaded.application), robot=loaded.robot, seed=loaded.run.seed,
            speed=self.launch.clock.speed, containers=list(loaded.world.containers))
        self.summary = self.fold.summary
        require_modules(loaded)
        require_safe(loaded)
        if endpoint is None:
            require_free_port(endpoint_of(number))
        self.cell = share.part_of(loaded)
        require_secured(self.launch, self.cell)
        self.launch = with_near(self.launch)
        self._supervisor: Supervisor | None = None
        self._collector: Collector | None = None
        self._screen: Screen | None = None
        self._page: PageAddress | None = None
        self._watchers: dict[str, list[str]] = {}  # commands by name
        self._disturbance: Disturbance | None = None
        self._chaos: Chaos | None = None
        self._doubts: asyncio.Task[None] | None = None
        self.first: Callable[[Bus], Awaitable[None]] | None = None  # is done at the terminal once the cell is up

    def serve_page(self, host: str | None, port: str | None) -> None:
        """Say where the operator's page is to be, if the cell has one; without this the cell's own words hold.

        Raises:
            ConfigError: there is no page, the port is taken, or host or port cannot be used.
        """
        from page.address import plan_page

        self._page = page = plan_page(self.cell, host, port)
        if page is not None:
            overrides = (*self.launch.overrides, *page.overrides)
            self.launch = replace(self.launch, overrides=overrides, extra=page.environment)

    def record_to(self, file: str | None) -> None:
        """Have a process beside the services record all that travels, from before they are ready to after their end.

        Raises:
            ConfigError: no recording can be made there.
        """
        if file is None:
            return
        from common.supervision.launch import module_command
        from common.transport.credentials import RECORDER
        from recording.capture import CustomTopics
        from recording.formatting import require_new
        from security.requiring import require_recorder

        path = Path(file).absolute()
        require_new(path, "--record")
        require_recorder(self.launch, self.cell)
        place = ["--connect", self.launch.connect] if self.launch.connect else ["--domain", str(self.launch.domain)]
        self._watchers[RECORDER] = [
            *module_command("cli.main"), "record", "--cell", self.cell.name, "-o", str(path), *place, "--gate",
            "--own", str(CustomTopics.of(self.cell)),
        ]

    def disturb(self, seed: int, per_minute: float, *, until_ended: bool) -> None:
        """Have faults made on purpose once the cell is up: without end, or until a run has time left to finish."""
        self._disturbance = Disturbance(seed, per_minute, until_ended)

    def leave_out(self, name: str) -> None:
        """Do not start a service."""
        kept = {key: entry for key, entry in self.cell.services.items() if entry.name != name}
        self.cell = self.cell.model_copy(update={"services": kept})

    def visit(self, visit: Callable[[Bus], Awaitable[T]]) -> T:
        """What a visit to the cell returns that is brought up for it.

        Raises:
            KeyboardInterrupt: a signal ended it.
        """
        results: list[T] = []

        async def work(bus: Bus) -> int:
            results.append(await visit(bus))
            return 0

        if asyncio.run(self._operate(work)) or not results:
            raise KeyboardInterrupt
        return results[0]

    def run_to_end(self) -> int:
        """Exit code of a run: 0 when the task is DONE, 1 when it is not, 130 after Ctrl-C.

        3 when it is DONE and something was left of which the summary says no reason: the simulated world knows.
        """
        from common.process.dropping_writer import DroppingWriter
        from common.supervision.supervisor import StartFailed
        from recording.report.summary import describe

        try:
            code = asyncio.run(self._operate(self._until_ended))
        except StartFailed:
            self.summary.failed = True
            self.write_summary()
            raise
        try:
            self.write_summary()
        finally:  # what became of the run is said also where the disk takes no file
            out = DroppingWriter(sys.stdout)
            for line in describe(self.summary.as_dict(), self.fold.figures):
                out.put(printable(line) + "\n")
            out.flush(LAST_WORDS)
        return LEFT if code == 0 and self.summary.unexplained else code

    def write_summary(self) -> None:
        """Write the figures, if a file was named for them."""
        if self.file is not None:
            self.summary.write(self.file)

    def stay(self) -> int:
        """Exit code of staying up until a signal: 0 when that came after the cell was up."""
        code = asyncio.run(self._operate(self._until_interrupted))
        self.write_summary()
        return 0 if self.summary.ready is not None else code

    async def _operate(self, work: Callable[[Bus], Awaitable[int]]) -> int:
        """Exit code of the work, done in the cell.

        What is simulated stays as it is through restarts, until the end; what persons decided outlives that.
        """
        from common.atomic_file import RUNTIME_VARIABLE, STATE_VARIABLE, state_folder
        from common.transport.endpoint import DEFAULT_DOMAIN

        if os.environ.get(STATE_VARIABLE):
            return await self._in_cell(work)
        kept = state_folder()
        if self._simulated and not self.launch.connect and self.launch.domain != DEFAULT_DOMAIN:
            kept /= f"domain-{self.launch.domain}"  # there may be many of a simulated robot
        with tempfile.TemporaryDirectory(prefix="zencell-") as folder:
            extra = {**self.launch.extra, STATE_VARIABLE: str(kept), RUNTIME_VARIABLE: folder}
            self.launch = replace(self.launch, extra=extra)
            return await self._in_cell(work)

    @property
    def _simulated(self) -> bool:
        from common.hardware.loading import is_simulated

        return is_simulated(self.cell.robot)

    async def _in_cell(self, work: Callable[[Bus], Awaitable[int]]) -> int:
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
        self._supervisor.start()  # before the rest of our own imports, which take as long as theirs
        try:
            self._open_screen(early)
            return await run_cell(self.cell, self.launch, self._supervisor, interrupts, work, self._prepare)
        except Interrupted:
            return 128 + (interrupts.signal or signal.SIGINT)
        finally:
            if self._doubts:
                self._doubts.cancel()
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
        from cli.session.live_table import Content

        assert self._supervisor is not None
        statuses = self._supervisor.statuses
        if self._collector is None:
            return Content(statuses, {}, self.fold.progress)
        rates = {status.name: self._collector.rates.busiest_of(status.name) for status in statuses}
        return Content(statuses, {name: rate for name, rate in rates.items() if rate}, self.fold.progress)

    def _prepare(self, bus: Bus) -> None:
        from recording.report.aggregator import Collector

        assert self._screen is not None
        self._collector = Collector(bus, self.fold, self.began, self._screen.progress)

    async def _until_ended(self, bus: Bus) -> int:
        from common import topics
        from common.client.joining import person
        from common.messages import TaskCommand
        from common.supervision.lifecycle import run_with_background

        collector = await self._came_up(bus)
        kept = await persisted_interlocks(bus, self.cell, self._note)
        if not self._simulated:
            self._tell_kept(kept)
        if (self._simulated and kept) or (not self.cell.run.autostart and not kept):  # who says `run` says start
            acknowledged = max((interlock.since for interlock in kept), default=0)  # a stop that comes now stays
            start = TaskCommand(command="start", by=person(), override=bool(kept), acknowledged=acknowledged)
            await bus.client(topics.TASK_COMMAND).call(start, START_REQUEST_TIMEOUT)
            for interlock in kept:
                self._note(f"Let go: {self.cell.name} was {interlock.description}")

        async def end() -> None:
            if self.first is not None:
                await self.first(bus)
            await collector.ended.wait()
            await collector.settle()

        await run_with_background(self._disturbing(), run_with_background(collector.run(), end()))
        if self._doubts is not None:  # of a short run: they may say why it was short
            await asyncio.wait({self._doubts}, timeout=DOUBTS_TIMEOUT)
        return 0 if self.summary.state == "DONE" else 1

    async def _until_interrupted(self, bus: Bus) -> int:
        from common.supervision.lifecycle import run_with_background
        from common.transport.endpoint import endpoint_of

        collector = await self._came_up(bus)
        assert self._screen is not None
        endpoint = endpoint_of(None if self.launch.connect else self.launch.domain, self.launch.connect)
        took = f"{self.summary.ready:.1f} s"
        self._screen.note(f"{self.cell.name} is up at {endpoint} after {took}. Read it from outside:")
        self._screen.note(zenoh_cli_line(endpoint, self.cell.name))
        self._tell_kept(await persisted_interlocks(bus, self.cell, self._note))
        await run_with_background(self._disturbing(), collector.run())
        return 0

    def _tell_kept(self, kept: list[Interlock]) -> None:
        for interlock in kept:
            verb = "start" if interlock.kind == "stopped" else "resume"
            self._note(f"{self.cell.name} is {interlock.description}: `zencell task {verb}` lets it go on")

    def _note(self, line: str) -> None:
        assert self._screen is not None
        self._screen.note(line)

    async def _tell_doubts(self) -> None:
        from tools.check.cell import QuickCheckFailed, warnings_in_subprocess

        try:
            for found in await warnings_in_subprocess(self.cell, self.launch.environment()):
                self._note(f"{found.severity}: {printable(found.line)}")
        except QuickCheckFailed as told:
            self._note(f"warning: {told}")

    async def _disturbing(self) -> None:
        if self._chaos is not None:
            await self._chaos.run()

    async def _came_up(self, bus: Bus) -> Collector:
        assert self._collector is not None
        self.summary.ready = time.monotonic() - self.began
        if self._page and self._screen:
            self._screen.note(f"Open {self._page.url}")
        self._doubts = asyncio.create_task(self._tell_doubts(), name="doubts")
        if self._disturbance is not None:
            from lab.chaos.agent import create_chaos, keys_of

            assert self._supervisor is not None
            seed, per_minute, until_ended = self._disturbance
            known = keys_of(await bus.owners(), [entry.name for entry in self.cell.services.values()])
            self._chaos = create_chaos(
                bus, self.cell, self._supervisor, known, seed, per_minute, until_ended=until_ended)
        return self._collector



def zenoh_cli_line(endpoint: str, cell: str) -> str:
    """A command line to paste that shows all of a cell with zenoh-cli."""
    line = "{key} {value}"
    return f"zenoh --mode client --connect {endpoint} subscribe -k '{cell}/**' --decoder msgpack --line '{line}'"
