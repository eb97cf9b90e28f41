"""Test of the complete cell on a virtual clock."""

from __future__ import annotations

from pathlib import Path

import zencell  # noqa: F401 - makes `common` importable, also from an installed wheel
from common import topics
from common.application import find_application
from common.config import load_cell
from common.messages import TaskCommand
from common.transport.bus import Bus
from lab.simulation import Simulation

CELL = str(Path(__file__).with_name("cell.yaml"))


def test_every_cube_ends_in_its_own_box() -> None:
    outcome = Simulation(load_cell(CELL, seed=2), 1).run()  # includes the truth check
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 4, 4, []), outcome


def test_task_continues_after_pauses_stops_and_restarts_of_its_process() -> None:
    cell = load_cell(CELL, seed=3)

    async def visit(bus: Bus) -> None:
        status, task = bus.reader(find_application(cell.application).status), bus.client(topics.TASK_COMMAND)
        for stage in ("descend", "across"):
            for commands in (("pause", "resume"), ("stop", "start"), ()):
                while (await status.next()).stage != stage:
                    pass
                for command in commands:
                    answer = await task.call(TaskCommand.model_validate({"command": command}))
                    assert answer.paused == (command == "pause")
            simulation.kill(cell.task)

    simulation = Simulation(cell, 2, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.done, outcome.restarts) == ("DONE", 4, {cell.task: 2}), outcome
