"""A cell that runs a program on the virtual clock, and an operator who commands it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from applications.programming.topics import PROGRAM_COMMAND, PROGRAM_STATUS, ProgramCommand, ProgramStatus
from common.config import load_cell
from common.messages import MotionStatus
from common.transport.bus import Bus
from common.transport.reader import Reader
from lab.simulation import Simulation

CELL = str(Path(__file__).parents[1] / "data" / "programs.yaml")


class Operator:
    """Commands the program of a cell, and watches its status."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.client = bus, bus.client(PROGRAM_COMMAND)
        self.statuses: Reader[ProgramStatus] = bus.reader(PROGRAM_STATUS)

    async def send(self, command: str, **fields: Any) -> ProgramStatus:
        return await self.client.call(ProgramCommand.model_validate({"command": command, **fields}), 30.0)

    async def until(self, condition: Callable[[ProgramStatus], bool]) -> ProgramStatus:
        if (known := self.statuses.latest) is not None and condition(known):
            return known
        async for status in self.statuses:
            if condition(status):
                return status
        raise AssertionError


def simulate(
    folder: Path, visit: Callable[[Operator], Awaitable[None]], *overrides: str, cell: str = CELL, limit: float = 120.0,
    made: list[Simulation] | None = None, state: str = "DONE",
) -> None:
    """Run a cell whose programs are in a folder, up to a state without a crash; `made` gets the simulation."""

    async def visited(bus: Bus) -> None:
        await visit(Operator(bus))

    loaded = load_cell(cell, (*overrides, f"services.program_runner.folder={folder}"))
    simulation = Simulation(loaded, 1, visit=visited, limit=limit)
    if made is not None:
        made.append(simulation)
    outcome = simulation.run()
    assert (outcome.state, outcome.crashes, outcome.broken) == (state, [], []), outcome


async def until(motion: Reader[MotionStatus], condition: Callable[[MotionStatus], bool]) -> MotionStatus:
    """Wait for a status of the arm."""
    if motion.latest is not None and condition(motion.latest):
        return motion.latest
    async for status in motion:
        if condition(status):
            return status
    raise AssertionError
