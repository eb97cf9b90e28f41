"""Test of the complete cell on a virtual clock."""

from __future__ import annotations

from pathlib import Path

import zencell  # noqa: F401 - makes `common` importable, also from an installed wheel
from common import topics
from common.config import load_cell
from common.transport.bus import Bus
from lab.simulation import Simulation

CELL = str(Path(__file__).with_name("cell.yaml"))


def test_both_parts_are_machined_and_put_into_the_tray() -> None:
    cell = load_cell(CELL)
    clamped: list[object] = [False]
    started: list[object] = [False]
    stamps: list[float] = []

    async def visit(bus: Bus) -> None:
        killed = False
        async for state in bus.reader(topics.IO_STATE):
            stamps.append(state.header.stamp * 1e-9)
            values = {signal.name: signal.value for signal in state.signals}
            for name, seen in (("clamp_closed", clamped), ("start", started)):
                if values[name] is not None and values[name] is not seen[-1]:
                    seen.append(values[name])
            assert values["clamp_closed"] or not values["busy"], "the machine works on a loose part"
            if values["busy"] and not killed:
                killed = True
                simulation.kill(cell.task)
            if len(clamped) == 5:
                return

    simulation = Simulation(cell, 1, visit=visit)
    outcome = simulation.run()  # includes the truth check
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 2, 2, []), outcome
    assert stamps[-1] - stamps[0] > 2 * 20.0, "it waited for the machine twice"
    assert (clamped, started) == ([False, True, False, True, False],) * 2, "also after a restart of the task"
