"""One cell that is up at this terminal: checked, started, watched, told of, and ended."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from cli import options, securing, viewing
from common.supervision.share import Share
from common.terminal import printable

if TYPE_CHECKING:
    from cli.screens import Content, Screen
    from common.chaos.agent import Chaos
    from common.checking.finding import Finding
    from common.config import Cell
    from common.messages import Inhibit
    from common.supervision.collector import Collector
    from common.supervision.supervisor import Supervisor
    from common.transport.bus import Bus

T = TypeVar("T")

START_REQUEST_TIMEOUT = 5.0  # [s]
LAST_WORDS = 5.0  # [s] for whoever is slow to read what became of a run
LEFT = 3  # exit code
FIRST_WORD = 2.0  # [s] in which the executor of a cell that is up has said how the robot is
EXECUTOR, OURSELVES = "trajectory_executor", ("watchdog", "controller", "scene_monitor")


class Disturbance(NamedTuple):
    """Faults that were asked for."""

    seed: int
    per_minute: float
    until_ended: bool  # rather than without end


class Operation:
    """One bring-up, as a person asked for it."""

    def __init__(
        self, cell: str, overrides: list[str] | None, world: str | None, seed: str | None, speed: str,
        domain: str | None, connect: str | None, no_viewer: bool, summary: str | None = None, log_json: bool = False,
        share: Share | None = None,
    ) -> None:
        """Check everything that was asked for; nothing is started yet.

        Raises:
            ConfigError, UnknownName: one line naming the option, the value and the choices.
        """
        from common.application import find_application
        from common.config import expanded, load_cell
        from common.errors import ConfigError
        from common.reporting.fold import Fold
        from common.supervision.launch import (
            Launch,
            clock_of,
            place_of,
            process_began,
            require_free_port,
            require_modules,
        )
        from common.transport.endpoint import endpoint_of
        from common.viewer.access import VIEWER

        self.began = process_began()
        self.file = Path(summary) if summary else None
        if self.file and not self.file.absolute().parent.is_dir():
            raise ConfigError("--summary", summary, "is in a folder that does not exist")
        share = share or Share()
        number, endpoint = place_of(domain, connect)
        factor = options.number("--speed", speed)
        self.launch = share.linked(Launch(
            cell=cell, overrides=tuple(expanded(overrides or ())), world=world, seed=options.whole("--seed", seed, 0),
            domain=number, connect=endpoint, log_json=log_json, clock=clock_of(factor, share.epoch(factor)),
        ))
        loaded = load_cell(cell, self.launch.overrides, world=world, seed=self.launch.seed)
        if no_viewer:
            kept = {name: entry for name, entry in loaded.services.items() if entry.kind != VIEWER}
            loaded = loaded.model_copy(update={"services": kept})
        self.cell: Cell = loaded
        self.fold = Fold(loaded.name, find_application(loaded.application), robot=loaded.robot, seed=loaded.run.seed,
                         speed=self.launch.clock.speed, containers=list(loaded.world.containers))
        self.summary = self.fold.summary
        require_modules(loaded)
        _require_safe(loaded)
        if endpoint is None:
            require_free_port(endpoint_of(number))
        self.cell = share.part_of(loaded)
        securing.require_secured(self.launch, self.cell)
        self.launch = securing.with_near(self.launch)
        self._supervisor: Supervisor | None = None
        self._collector: Collector | None = None
        self._screen: Screen | None = None
        self._page: viewing.Page | None = None
        self._watchers: dict[str, list[str]] = {}  # commands by name
        self._disturbance: Disturbance | None = None
        self._chaos: Chaos | None = None
        self._doubts: asyncio.Task[list[Finding]] | None = None
        self.first: Callable[[Bus], Awaitable[None]] | None = None  # is done at the terminal once the cell is up

    def serve_page(self, host: str | None, port: str | None) -> None:
        """Say where the operator's page is to be, if the cell has one; without this the cell's own words hold.

        Raises:
            ConfigError: there is no page, the port is taken, or host or port cannot be used.
        """
        self._page = page = viewing.page_of(self.cell, host, port)
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
        from common.recording.own import Own
        from common.recording.telling import require_new
        from common.supervision.launch import python_module
        from common.transport.credentials import RECORDER

        path = Path(file).absolute()
        require_new(path, "--record")
        securing.require_recorder(self.launch, self.cell)
        place = ["--connect", self.launch.connect] if self.launch.connect else ["--domain", str(self.launch.domain)]
        self._watchers[RECORDER] = [
            *python_module("cli.main"), "record", "--cell", self.cell.name, "-o", str(path), *place, "--gate",
            "--own", str(Own.of(self.cell)),
        ]

    def disturb(self, seed: str | None, rate: str | None, *, until_ended: bool) -> None:
        """Have faults made on purpose once the cell is up: without end, or until a run has time left to finish.

        Raises:
            ConfigError: seed or rate cannot be used.
        """
        from common.chaos.plan import MOST_PER_MINUTE, PER_MINUTE
        from common.errors import ConfigError

        number = options.whole("--chaos", seed, 0)
        per_minute = PER_MINUTE if rate is None else options.number("--chaos-rate", rate)
        if not 0 < per_minute <= MOST_PER_MINUTE:
            raise ConfigError("--chaos-rate", rate, f"must be more than 0 and at most {MOST_PER_MINUTE:g} [1/min]")
        if rate is not None and number is None:
            raise ConfigError("--chaos-rate", rate, "needs --chaos SEED")
        self._disturbance = None if number is None else Disturbance(number, per_minute, until_ended)

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
        from common.process.lossy import LossyWriter
        from common.reporting.summary import describe
        from common.supervision.supervisor import StartFailed

        try:
            code = asyncio.run(self._operate(self._until_ended))
        except StartFailed:
            self.summary.failed = True
            self._write_summary()
            raise
        self._write_summary()
        out = LossyWriter(sys.stdout)
        for line in describe(self.summary.as_dict(), self.fold.figures):
            out.put(printable(line) + "\n")
        out.flush(LAST_WORDS)
        return LEFT if code == 0 and self.summary.unexplained else code

    def stay(self) -> int:
        """Exit code of staying up until a signal: 0 when that came after the cell was up."""
        code = asyncio.run(self._operate(self._until_interrupted))
        self._write_summary()
        return 0 if self.summary.ready is not None else code

    async def _operate(self, work: Callable[[Bus], Awaitable[int]]) -> int:
        """Exit code of the work, done in the cell.

        What is simulated stays as it is through restarts, until the end; what persons decided outlives that.
        """
        from common.kept_file import lasting_folder
        from common.sim.standing import STANDING_VARIABLE, STATE_VARIABLE
        from common.transport.endpoint import DEFAULT_DOMAIN

        if os.environ.get(STATE_VARIABLE):
            return await self._in_cell(work)
        kept = lasting_folder()
        if self._simulated and not self.launch.connect and self.launch.domain != DEFAULT_DOMAIN:
            kept /= f"domain-{self.launch.domain}"  # there may be many of a simulated robot
        with tempfile.TemporaryDirectory(prefix="zencell-") as folder:
            extra = {**self.launch.extra, STATE_VARIABLE: str(kept), STANDING_VARIABLE: folder}
            self.launch = replace(self.launch, extra=extra)
            return await self._in_cell(work)

    @property
    def _simulated(self) -> bool:
        from common.hardware.loading import is_simulated

        return is_simulated(self.cell.robot)

    async def _in_cell(self, work: Callable[[Bus], Awaitable[int]]) -> int:
        from common.supervision.interrupts import Interrupts
        from common.supervision.operation import Interrupted, operate
        from common.supervision.supervisor import Supervisor

        interrupts = Interrupts()
        interrupts.install()
        early: list[tuple[str, str]] = []

        def show(name: str, text: str) -> None:
            if self._screen is None:
                early.append((name, text))
            else:
                self._screen.line(name, text)

        self._supervisor = Supervisor(self.cell, self.launch, show, self._watchers)
        self._supervisor.begin()  # before the rest of our own imports, which take as long as theirs
        try:
            self._open_screen(early)
            return await operate(self.cell, self.launch, self._supervisor, interrupts, work, self._prepare)
        except Interrupted:
            return 128 + (interrupts.signal or signal.SIGINT)
        finally:
            if self._collector:
                self._collector.read_truth()
            self.summary.restarts = self._supervisor.restarts
            self.summary.chaos = self._chaos.as_dicts() if self._chaos else None
            if self._screen:
                self._screen.close()

    def _open_screen(self, early: list[tuple[str, str]]) -> None:
        from cli.screens import ScreenHandler, open_screen

        self._screen = open_screen(self._content, log_json=self.launch.log_json, plain=self.first is not None)
        for name, text in early:
            self._screen.line(name, text)
        root = logging.getLogger()
        root.addHandler(ScreenHandler(self._screen, log_json=self.launch.log_json))
        root.setLevel(logging.INFO)

    def _content(self) -> Content:
        from cli.screens import Content

        assert self._supervisor is not None
        statuses = self._supervisor.statuses
        if self._collector is None:
            return Content(statuses, {}, self.fold.progress)
        rates = {status.name: self._collector.rates.busiest_of(status.name) for status in statuses}
        return Content(statuses, {name: rate for name, rate in rates.items() if rate}, self.fold.progress)

    def _prepare(self, bus: Bus) -> None:
        from common.supervision.collector import Collector

        assert self._screen is not None
        self._doubts = asyncio.create_task(asyncio.to_thread(_doubts, self.cell))  # while services come up
        self._collector = Collector(bus, self.fold, self.began, self._screen.progress)

    async def _until_ended(self, bus: Bus) -> int:
        from common import topics
        from common.client.joining import person
        from common.messages import TaskCommand
        from common.supervision.operation import beside

        collector = await self._came_up(bus)
        kept = await self._kept(bus)
        if not self._simulated:
            self._tell_kept(kept)
        if (self._simulated and kept) or (not self.cell.run.autostart and not kept):  # who says `run` says start
            heard = max((inhibit.since for inhibit in kept), default=0)  # a stop that comes now stays
            start = TaskCommand(command="start", by=person(), override=bool(kept), heard=heard)
            await bus.client(topics.TASK_COMMAND).call(start, START_REQUEST_TIMEOUT)
            for inhibit in kept:
                self._note(f"Let go: {self.cell.name} was {inhibit.told}")

        async def end() -> None:
            if self.first is not None:
                await self.first(bus)
            await collector.ended.wait()
            await collector.settle()

        await beside(self._disturbing(), beside(collector.run(), end()))
        return 0 if self.summary.state == "DONE" else 1

    async def _until_interrupted(self, bus: Bus) -> int:
        from common.supervision.operation import beside
        from common.transport.endpoint import endpoint_of

        collector = await self._came_up(bus)
        assert self._screen is not None
        endpoint = endpoint_of(None if self.launch.connect else self.launch.domain, self.launch.connect)
        took = f"{self.summary.ready:.1f} s"
        self._screen.note(f"{self.cell.name} is up at {endpoint} after {took}. Read it from outside:")
        self._screen.note(zenoh_cli_line(endpoint, self.cell.name))
        self._tell_kept(await self._kept(bus))
        await beside(self._disturbing(), collector.run())
        return 0

    async def _kept(self, bus: Bus) -> list[Inhibit]:
        """What persons stopped or hold since before the cell came up; says so when they made it slower."""
        from common import topics

        if not any(entry.kind == EXECUTOR for entry in self.cell.services.values()):
            return []  # on another host, or a cell without an arm
        reader, motion = bus.reader(topics.MOTION_STATUS), None
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_WORD):
                motion = reader.latest or await reader.next()
        if motion is None:
            return []
        if motion.speed_scaling < 1:
            set_it = f"`zencell param set services.{EXECUTOR}.speed_scaling=1`"
            self._note(f"Motions go at {100 * motion.speed_scaling:.0f} % of their speed: {set_it} ends that")
        return [inhibit for inhibit in motion.inhibits if inhibit.by not in OURSELVES]

    def _tell_kept(self, kept: list[Inhibit]) -> None:
        for inhibit in kept:
            verb = "start" if inhibit.kind == "stopped" else "resume"
            self._note(f"{self.cell.name} is {inhibit.told}: `zencell task {verb}` lets it go on")

    def _note(self, line: str) -> None:
        assert self._screen is not None
        self._screen.note(line)

    async def _disturbing(self) -> None:
        if self._chaos is not None:
            await self._chaos.run()

    async def _came_up(self, bus: Bus) -> Collector:
        assert self._collector is not None
        self.summary.ready = time.monotonic() - self.began
        if self._page and self._screen:
            self._screen.note(f"Open {self._page.address}")
        for found in await self._doubts if self._doubts is not None else ():
            self._note(f"{found.severity}: {printable(found.line)}")
        if self._disturbance is not None:
            from common.chaos.setting import chaos_in, keys_of

            assert self._supervisor is not None
            seed, per_minute, until_ended = self._disturbance
            known = keys_of(await bus.owners(), [entry.name for entry in self.cell.services.values()])
            self._chaos = chaos_in(bus, self.cell, self._supervisor, known, seed, per_minute, until_ended=until_ended)
        return self._collector

    def _write_summary(self) -> None:
        if self.file is None:
            return
        text = json.dumps(self.summary.as_dict(), indent=2) + "\n"
        beside_it = self.file.with_name(self.file.name + ".part")
        beside_it.write_text(text, encoding="utf-8")
        beside_it.replace(self.file)  # a reader sees all of it or none


def _require_safe(cell: Cell) -> None:
    """Return when nothing is known because of which the arm or its fingers would move wrongly.

    Raises:
        ConfigError: something is; as `zencell check` says it.
    """
    from common.checking.cell import refused
    from common.errors import ConfigError

    for found in refused(cell):
        field, _, rest = found.line.partition(": ")
        raise ConfigError(field, ..., rest)


def _doubts(cell: Cell) -> list[Finding]:
    """What else will not work, as far as it is told quickly."""
    from common.checking.cell import quick

    return [found for found in quick(cell) if not found.refused]


def zenoh_cli_line(endpoint: str, cell: str) -> str:
    """A command line to paste that shows all of a cell with zenoh-cli."""
    line = "{key} {value}"
    return f"zenoh --mode client --connect {endpoint} subscribe -k '{cell}/**' --decoder msgpack --line '{line}'"


def end_with_stdin() -> None:
    """Have this process take the end of its standard input for Ctrl-C, also should nobody be left to close it."""

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(sys.stdin.fileno(), 4096):
                pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=watch, name="stdin", daemon=True).start()
