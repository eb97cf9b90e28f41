"""The whole cell on a virtual clock: nothing of it waits."""

from __future__ import annotations

from pathlib import Path

import pytest

import zencell  # noqa: F401 - `from common...` can be imported from then on, also where zencell came as a wheel
from common import topics
from common.application import find_application
from common.config import load_cell
from common.messages import TaskCommand, TaskStatus
from common.transport.bus import Bus
from common.transport.reader import Reader
from lab.simulation import Simulation

CELL = str(Path(__file__).with_name("cell.yaml"))


async def heard(status: Reader[TaskStatus], stage: str) -> None:
    """Return when the task is at a stage."""
    async for told in status:
        if told.stage == stage:
            return


def test_every_cube_is_in_its_own_box_by_truth() -> None:
    outcome = Simulation(load_cell(CELL, seed=2), 1).run()  # at the end it calls the truth check
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", 4, 4, []), outcome


@pytest.mark.parametrize("stage", ["descend", "across"])
def test_task_goes_on_where_it_was_after_pause_stop_and_the_end_of_its_process(stage: str) -> None:
    cell = load_cell(CELL, seed=3)

    async def visit(bus: Bus) -> None:
        status = bus.reader(find_application(cell.application).status)
        task = bus.client(topics.TASK_COMMAND)
        for commands in (("pause", "resume"), ("stop", "start")):
            await heard(status, stage)
            for command in commands:
                told = await task.call(TaskCommand.model_validate({"command": command}))
                assert told.paused == (command == "pause")
        await heard(status, stage)
        simulation.kill(cell.task)

    simulation = Simulation(cell, 2, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.done, outcome.restarts) == ("DONE", 4, {cell.task: 1}), outcome
