"""The tending cell on a virtual clock: parts end on the pallet, and what happens when clamp, machine or task fail."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from common import topics
from common.application import find_application
from common.config import Cell, load_cell
from common.messages import TaskCommand
from common.transport.bus import Bus
from lab.simulation import Simulation

FASTER = ["motion.velocity_scaling=0.8", "motion.acceleration_scaling=1.0", "services.depth_camera.rate=1.0",
          "world.camera.width=320", "world.camera.height=240", "world.camera.fx=400", "world.camera.fy=400",
          "world.camera.cx=160", "world.camera.cy=120"]  # half the resolution


def cell(seed: int, *settings: str, count: int = 1, seconds: float = 2.0) -> Cell:
    machine = f"io.options.behaviors.busy={{started_by: start, after: 0.1, seconds: {seconds}}}"
    return load_cell("tending", [f"world.generator.count={count}", *FASTER, machine, *settings], seed=seed)


class Signals:
    """Changes of signals until the clamp has opened so many times; the machine must only work on clamped parts."""

    def __init__(self, opened: int) -> None:
        self.opened, self.changes = opened, list[tuple[str, Any]]()

    async def watch(self, bus: Bus) -> None:
        before: dict[str, Any] = {}
        async for state in bus.reader(topics.IO_STATE):
            values = {signal.name: signal.value for signal in state.signals}
            assert values["clamp_closed"] or not values["busy"], "the machine works on a loose part"
            self.changes += [(name, values[name]) for name in values if values[name] != before.get(name, False)]
            before = values
            if self.changes.count(("clamp_closed", False)) == self.opened:
                return

    def count(self, name: str) -> int:
        """How often a signal was switched on."""
        return self.changes.count((name, True))


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "count"), [(1, 1), (2, 1), (3, 3)])
def test_every_part_is_machined_once_and_ends_in_a_slot_of_the_pallet(seed: int, count: int) -> None:
    signals = Signals(count)
    outcome = Simulation(cell(seed, count=count), seed, visit=signals.watch).run()  # includes the truth check
    assert (outcome.state, outcome.done, outcome.total, outcome.crashes) == ("DONE", count, count, []), outcome
    assert [signals.count(name) for name in ("clamp", "start", "busy")] == [count] * 3


@pytest.mark.slow
def test_task_killed_while_the_machine_works_and_while_a_part_is_carried_machines_no_part_twice() -> None:
    config, signals = cell(2), Signals(1)

    async def visit(bus: Bus) -> None:
        status = bus.reader(find_application(config.application).status)
        watching = asyncio.create_task(signals.watch(bus))
        for stage in ("machine works", "across"):
            while (await status.next()).stage != stage:
                pass
            simulation.kill(config.task)
        await watching

    simulation = Simulation(config, 2, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.done, outcome.restarts) == ("DONE", 1, {config.task: 2}), outcome
    assert [signals.count(name) for name in ("clamp", "start", "busy")] == [1, 1, 1]


@pytest.mark.slow
def test_clamp_that_does_not_close_is_closed_again_once_and_the_machine_never_starts() -> None:
    changes: list[tuple[str, Any]] = []

    async def visit(bus: Bus) -> None:
        async for state in bus.reader(topics.IO_STATE):
            found = {signal.name: signal.value for signal in state.signals}
            changes.append((str(found["clamp"]), found["start"]))
            if [clamp for clamp, _ in changes].count("True") and changes[-1][0] == "False":
                return

    outcome = Simulation(cell(1, "io.options.behaviors={busy: {started_by: start, seconds: 2}}"), 1, visit=visit).run()
    assert outcome.state == "ERROR" and outcome.message == (
        "clamp: clamp_closed is on was not seen within 2 s; see to it, then start the task")
    assert not any(start for _, start in changes)


@pytest.mark.slow
def test_machine_that_takes_too_long_ends_the_task_and_a_start_waits_again_without_starting_it_twice() -> None:
    config, signals, errors = cell(3, "services.tender.machine_timeout=3", seconds=8.0), Signals(1), set[str]()

    async def visit(bus: Bus) -> None:
        status, task = bus.reader(find_application(config.application).status), bus.client(topics.TASK_COMMAND)
        watching = asyncio.create_task(signals.watch(bus))
        while not watching.done():
            message = await status.next()
            if message.state == "ERROR":
                errors.add(message.message)
                await task.call(TaskCommand(command="start"))
        await watching

    outcome = Simulation(config, 3, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.crashes) == ("DONE", 1, []), outcome
    assert errors == {"machine works: busy is off was not seen within 3 s; see to it, then start the task"}
    assert [signals.count(name) for name in ("clamp", "start", "busy")] == [1, 1, 1]
