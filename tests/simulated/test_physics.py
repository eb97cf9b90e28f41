"""Whole cells in the world with physics, on the virtual clock: one line in the cell, and nothing else knows."""

from __future__ import annotations

import pytest

from common import topics
from common.transport.bus import Bus
from tests.simulated.visited import SimulatedCell

pytest.importorskip("mujoco")
pytestmark = pytest.mark.timeout(600)
PHYSICS = "world.simulator=mujoco"


@pytest.mark.slow
def test_table_is_cleared_by_friction_alone() -> None:
    summary = SimulatedCell("panda", [PHYSICS, "world.count=1"]).summary
    assert (summary["state"], summary["placed"]) == ("DONE", 1)
    assert summary["truth"] == {"in_box": 1, "on_table": 0, "elsewhere": 0, "containers": {"box": 1}}


@pytest.mark.slow
def test_executor_killed_while_holding_finds_the_object_again() -> None:
    async def visit(cell: SimulatedCell, bus: Bus) -> None:
        async for state in bus.reader(topics.GRIPPER_STATE):
            if state.holding and state.outcome == "grasped":
                break
        await bus.clock.sleep(1.0)  # on its way
        cell.kill("trajectory_executor")

    summary = SimulatedCell("panda", [PHYSICS, "world.count=1"], visit=visit).summary
    assert summary["restarts"] == {"trajectory_executor": 1}
    assert (summary["state"], summary["truth"]["in_box"]) == ("DONE", 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_pile_of_seven_stays_in_the_box(seed: int) -> None:
    summary = SimulatedCell("panda", [PHYSICS, "world.layout=random", f"seed={seed}"], seed=seed).summary
    assert summary["state"] == "DONE"
    assert summary["truth"] == {"in_box": 7, "on_table": 0, "elsewhere": 0, "containers": {"box": 7}}


@pytest.mark.slow
def test_outline_with_servo_physics_is_as_accurate_as_without() -> None:
    summary = SimulatedCell("ur5", [PHYSICS], world="w2").summary
    assert summary["state"] == "DONE"
    assert summary["outline"]["deviation_mm"]["mean"] < 0.5 and summary["outline"]["closed"]
