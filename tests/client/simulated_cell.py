"""Run a program of the Python client in a complete simulated cell on the virtual clock."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from common.client.cell import Cell
from common.config import load_cell
from common.transport.bus import Bus
from lab.simulation import Simulation


class Ended(Exception):
    """The program has ended; the rest of the run does not matter."""


def run(program: Callable[[Cell], Awaitable[None]], cell: str = "panda", *overrides: str) -> None:
    """Run a program of the operator `program` in a cell to its end."""
    run_with_processes(lambda _, joined: program(joined), cell, *overrides)


def run_with_processes(
    program: Callable[[Simulation, Cell], Awaitable[None]], cell: str = "panda", *overrides: str
) -> None:
    """Run a program that may also kill processes of the cell."""
    raised: list[BaseException] = []

    async def visit(bus: Bus) -> None:
        try:
            async with Cell.on(bus, owner="program") as joined:
                await program(simulation, joined)
        except BaseException as error:
            raised.append(error)
        raise Ended

    simulation = Simulation(load_cell(cell, ["autostart=false", *overrides]), 1, visit=visit)
    with pytest.raises(Ended):
        simulation.run()
    if raised:
        raise raised[0]
    assert not simulation.outcome.broken and not simulation.outcome.crashes, simulation.outcome


async def moving(cell: Cell) -> None:
    """Wait until the arm moves."""
    async with asyncio.timeout(5.0):
        while np.abs(await cell.arm.velocities()).max() < 0.02:
            pass


async def standstill(cell: Cell) -> None:
    """Wait until the arm has stopped."""
    async with asyncio.timeout(5.0):
        while np.abs(await cell.arm.velocities()).max() > 1e-6:
            pass
