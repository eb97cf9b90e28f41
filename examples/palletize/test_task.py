"""Test of the complete cell on a virtual clock."""

from __future__ import annotations

from pathlib import Path

import zencell  # noqa: F401 - makes `common` importable, also from an installed wheel
from common.application import find_application
from common.config import load_cell
from common.transport.bus import Bus
from lab.simulation import Simulation

CELL = str(Path(__file__).with_name("cell.yaml"))
SMALL = ["world.camera.width=320", "world.camera.height=240", "world.camera.fx=400", "world.camera.fy=400",
         "world.camera.cx=160", "world.camera.cy=120"]


def test_both_layers_are_complete_also_after_restarts_of_the_task() -> None:
    cell = load_cell(CELL, SMALL, seed=1)

    async def visit(bus: Bus) -> None:
        status = bus.reader(find_application(cell.application).status)
        for done, stage in ((1, "lift"), (5, "across")):
            while (message := await status.next()).done < done or message.stage != stage:
                pass
            simulation.kill(cell.task)

    simulation = Simulation(cell, 1, visit=visit)
    outcome = simulation.run()  # includes the truth check
    assert (outcome.state, outcome.done, outcome.crashes) == ("DONE", 8, []), outcome
    assert outcome.restarts == {cell.task: 2}
