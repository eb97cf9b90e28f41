"""Complete cells on virtual time, with a visitor that observes and breaks things, or in place of `zencell run`.

The result has the figures of the summary of `zencell run`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import typer

from cli.session.session import CellSession
from common import topics
from common.application import find_application
from common.config import Cell, load_cell
from common.messages import TaskCommand
from common.transport.bus import Bus
from lab.observers import Trace
from lab.simulation import Outcome, Simulation
from recording.capture import CustomTopics
from recording.report.aggregator import Collector, RunAggregator
from recording.report.summary import describe
from tests.harness import running_with

Visit = Callable[["SimulatedCell", Bus], Coroutine[Any, Any, None]]


def in_box(count: int) -> dict[str, Any]:
    """Return the ground truth of a table whose balls are all in the box."""
    return {"in_box": count, "on_table": 0, "elsewhere": 0, "containers": {"box": count}}


class SimulatedCell:
    """A run of a cell: outcome, summary and log lines."""

    def __init__(
        self, cell: str | Path | Cell, overrides: Sequence[str] = (), *, world: str | None = None, seed: int = 1,
        visit: Visit | None = None, limit: float = 300.0, record: Path | None = None,
    ) -> None:
        """Run the cell to the end of its task; invariants must hold, and no service may crash by itself.

        Args:
            cell: name or file, or resolved.
            overrides: as of `--set`.
            world: name of another.
            seed: of the simulation.
            visit: coroutine that runs once the cell is ready, with a bus of the cell.
            limit: virtual time in which the task has to end [s].
            record: file for a recording.
        """
        loaded = cell if isinstance(cell, Cell) else load_cell(str(cell), overrides, world=world)
        self.cell = loaded
        self.lines: list[str] = []
        self.ended = asyncio.Event()  # the task
        self._visit = visit
        self._aggregator = RunAggregator(
            loaded.name, find_application(loaded.application), robot=loaded.robot, seed=loaded.run.seed,
            containers=list(loaded.world.containers))
        trace = None if record is None else Trace(record, {"cell": loaded.name}, CustomTopics.of(loaded))
        self._simulation = Simulation(
            loaded, seed, limit=limit, trace=trace, log=self.lines.append, visit=self._observe)
        self.outcome: Outcome = self._simulation.run()
        if trace is not None:
            trace.close("simulated")
        assert not self.outcome.broken and not self.outcome.crashes, self.outcome

    async def _observe(self, bus: Bus) -> None:
        collector = Collector(bus, self._aggregator, 0.0, lambda line: None)
        self.ended = collector.ended
        async with running_with(collector.run()):
            if self._visit is not None:
                await self._visit(self, bus)
            await collector.ended.wait()
            await collector.settle()

    def kill(self, name: str) -> None:
        """Kill a process, as SIGKILL does."""
        self._simulation.kill(name)

    def lose_router(self, seconds: float) -> None:
        """Cut all links for a time [s]."""
        self._simulation.lose_router(seconds)

    @property
    def summary(self) -> dict[str, Any]:
        """Summary of the run, as `--summary` writes it."""
        self._aggregator.summary.restarts = self.outcome.restarts
        return self._aggregator.summary.as_dict()

    @property
    def text(self) -> str:
        """All log lines."""
        return "\n".join(self.lines)


@contextmanager
def no_processes() -> Iterator[None]:
    """Let `zencell run` in this process run its cell on virtual time during the block."""
    with patch.object(CellSession, "run_to_end", _run_to_end):
        yield


def _run_to_end(operation: CellSession) -> int:
    async def work(bus: Bus) -> None:
        collector = Collector(bus, operation.aggregator, 0.0, lambda line: None)
        async with running_with(collector.run()):
            if not operation.cell.run.autostart:
                await bus.client(topics.TASK_COMMAND).call(TaskCommand(command="start"))
            await collector.ended.wait()
            await collector.settle()

    outcome = Simulation(operation.cell, 1, visit=work).run()
    assert not outcome.broken and not outcome.crashes, outcome
    operation.summary.restarts = outcome.restarts
    operation.write_summary()
    for line in describe(operation.summary.as_dict(), operation.aggregator.figures):
        typer.echo(line)
    return 0 if operation.summary.state == "DONE" else 1
