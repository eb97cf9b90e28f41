"""A task with inputs and outputs in a complete cell on the virtual clock."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from common import topics
from common.client.cell import Cell
from common.config import load_cell
from common.transport.bus import Bus
from lab.simulation import Simulation
from tests.doubles.lossy_io import Server
from tests.harness import until

CELL = str(Path(__file__).parents[1] / "data" / "clamping.yaml")


def test_task_clamps_moves_and_waits_for_the_machine() -> None:
    events: list[tuple[str, object]] = []
    held = []

    async def visit(bus: Bus) -> None:
        states, motion = bus.reader(topics.IO_STATE), bus.reader(topics.MOTION_STATUS)
        while len(events) < 8:
            for signal in (await states.next()).signals:
                if signal.value is not None and signal.value is not dict(events).get(signal.name, False):
                    events.append((signal.name, signal.value))
            if motion.latest is not None:
                held.append(motion.latest.held)

    outcome = Simulation(load_cell(CELL), 1, visit=visit).run()
    assert (outcome.state, outcome.crashes, outcome.broken) == ("DONE", [], []), outcome
    assert events == [("clamp", True), ("clamp_closed", True), ("start", True), ("busy", True), ("start", False),
                      ("busy", False), ("clamp", False), ("clamp_closed", False)]
    assert not any(held)


def test_motion_that_requires_a_signal_is_held_while_its_server_or_service_is_gone() -> None:
    Server.restart(clamp=False, start=False, clamp_closed=False, busy=False)

    async def visit(bus: Bus) -> None:
        motion, cell = bus.reader(topics.MOTION_STATUS), Cell.on(bus)

        async def signal(name: str, value: bool, **then: Any) -> None:
            await cell.io.wait(name, value, 20.0)
            Server.values.update(then)

        await signal("clamp", True, clamp_closed=True)
        await until(motion, lambda status: status.state == "active")
        Server.down = "unplugged"
        lost = await until(motion, lambda status: status.held)
        assert lost.interlocks[0].reason == "unplugged" and lost.held_by == ["watchdog"]
        await asyncio.sleep(1.0)
        Server.down = ""
        await until(motion, lambda status: not status.held)
        simulation.kill("io")
        gone = await until(motion, lambda status: status.held)
        assert gone.interlocks[0].reason == "the I/O service does not answer"
        await until(motion, lambda status: not status.held and status.state == "succeeded")
        await signal("start", True, busy=True)
        await signal("start", False, busy=False)
        await signal("clamp", False, clamp_closed=False)

    overrides = ("io.backend=tests.doubles.lossy_io", "io.options={}")
    simulation = Simulation(load_cell(CELL, overrides), 1, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.crashes, outcome.broken) == ("DONE", [], []), outcome
    assert [name for name, _ in Server.writes] == ["clamp", "start", "start", "clamp"]
