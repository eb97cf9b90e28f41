"""Run a program of the Python client in a complete simulated cell on the virtual clock."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import numpy as np

from common.client.cell import Cell
from common.transport.bus import Bus
from tests.simulated.visited import SimulatedCell

Program = Callable[[Cell], Awaitable[None]]


class Ended(Exception):
    """The program has ended; the rest of the run does not matter."""


def run(program: Program, cell: str = "panda", *overrides: str) -> None:
    """Run a program of the operator `program` in a cell to its end."""
    run_with_processes(lambda _, joined: program(joined), cell, *overrides)


def run_with_processes(
    program: Callable[[SimulatedCell, Cell], Awaitable[None]], cell: str = "panda", *overrides: str
) -> None:
    """Run a program that may also kill processes of the cell."""

    async def visit(simulated: SimulatedCell, bus: Bus) -> None:
        async with Cell.on(bus, owner="program") as joined:
            await program(simulated, joined)
        raise Ended

    try:
        SimulatedCell(cell, ["autostart=false", *overrides], visit=visit)
    except Ended:
        return
    raise AssertionError("the run ended before the program")


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
