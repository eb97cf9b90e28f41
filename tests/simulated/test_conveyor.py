"""A complete cell that picks from a running belt by images, on the virtual clock."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from applications.belt_picking.topics import BELT_PICKING_STATUS
from common import topics
from common.config import Cell, load_cell
from common.messages import ConveyorSet, GripperState, MotionStatus
from common.transport.bus import Bus
from lab.simulation import Simulation
from tests.harness import until

pytestmark = pytest.mark.slow


def cell(y: float, speed: float, end: str = "fall") -> Cell:
    """Return the cell with one cube on the belt, at this y [m] at the start."""
    cube = {"id": "cube", "shape": "box", "size": [0.04, 0.04, 0.04], "x": 0.52, "y": y, "z": 0.06, "yaw": 0.4,
            "color": [0.9, 0.1, 0.1]}
    return load_cell("conveyor", [
        f"world.objects={json.dumps([cube])}", f"world.conveyors.belt.speed={speed}", "services.depth_camera.rate=5",
        f"world.conveyors.belt.end={end}", "services.belt_picker.settle=1"])


@pytest.mark.parametrize(("y", "speed", "end"), [(-0.75, 0.2, "fall"), (0.6, 0.2, "wrap")])
def test_cube_is_picked_from_the_moving_belt_and_put_into_the_box(y: float, speed: float, end: str) -> None:
    held: list[float] = []

    async def visit(bus: Bus) -> None:
        states, gripper = bus.reader(topics.CONVEYOR_STATE), bus.reader(topics.GRIPPER_STATE)
        grasped = await until(gripper, lambda state: state.outcome == "grasped")
        assert states.latest is not None
        held.extend((states.latest.belts[0].speed, grasped.width))

    outcome = Simulation(cell(y, speed, end), 1, limit=60.0, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.crashes, outcome.broken) == ("DONE", 1, [], []), outcome
    assert held == pytest.approx([speed, 0.04], abs=1e-3)


def test_belt_that_stops_before_the_grasp_ends_the_motion_with_open_fingers_and_it_is_tried_again() -> None:
    seen: dict[str, Any] = {}

    async def visit(bus: Bus) -> None:
        motion, gripper = bus.reader(topics.MOTION_STATUS), bus.reader(topics.GRIPPER_STATE)
        status, set_ = bus.reader(BELT_PICKING_STATUS), bus.client(topics.CONVEYOR_SET)
        await until(status, lambda one: one.stage == "track")
        await until(motion, lambda one: one.state == "active" and one.progress > 0.3)
        await set_.call(ConveyorSet(running=False, owner="belt_picker"))
        ended: MotionStatus = await until(motion, lambda one: one.state != "active")
        open_: GripperState = await until(gripper, lambda _: True)
        seen.update(state=ended.state, progress=ended.progress, width=open_.width)
        await set_.call(ConveyorSet(running=True, owner="belt_picker"))

    outcome = Simulation(cell(-0.3, 0.08), 1, limit=90.0, visit=visit).run()
    assert (outcome.state, outcome.done, outcome.crashes, outcome.broken) == ("DONE", 1, [], []), outcome
    assert seen["state"] == "cancelled"
    assert seen["progress"] < 0.7
    assert seen["width"] > 0.06


def test_late_arm_meets_the_cube_again_from_where_it_is_and_leaves_the_planner_the_time_it_needed() -> None:
    states: list[str] = []
    waits: list[float] = []  # for the start, after the motion was accepted [s]

    async def visit(bus: Bus) -> None:
        motion = bus.reader(topics.MOTION_STATUS)
        for _ in range(2):
            waits.append(-(await until(motion, lambda one: one.state == "active")).path_time)
            await until(motion, lambda one: one.progress > 0.3)
            simulation.pause("trajectory_executor", 0.3)
            states.append((await until(motion, lambda one: one.state != "active")).state)

    simulation = Simulation(cell(-0.45, 0.12), 1, limit=60.0, visit=visit)
    outcome = simulation.run()
    assert (outcome.state, outcome.done, outcome.crashes, outcome.broken) == ("DONE", 1, [], []), outcome
    assert states == ["cancelled"] * 2
    assert waits[0] > 0.4 and waits[1] < 0.3


def test_cube_gets_into_the_box_and_is_counted_although_restarts_forgot_what_it_is() -> None:
    async def visit(bus: Bus) -> None:
        motion, status = bus.reader(topics.MOTION_STATUS), bus.reader(BELT_PICKING_STATUS)
        await until(status, lambda one: one.stage == "track")
        await until(motion, lambda one: one.state == "active" and one.progress > 0.6)
        simulation.kill("scene_manager")
        await until(status, lambda one: one.done == 1)
        await asyncio.sleep(1.0)  # virtual: it is written in the background
        simulation.kill("belt_picker")

    simulation = Simulation(cell(-0.3, 0.08), 1, limit=90.0, visit=visit)
    outcome = simulation.run()
    restarts = {"scene_manager": 1, "belt_picker": 1}
    assert (outcome.state, outcome.done, outcome.restarts) == ("DONE", 1, restarts), outcome
