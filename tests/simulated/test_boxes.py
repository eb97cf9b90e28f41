"""Boxes that a camera detects are gripped by their narrow sides and put into the container, as balls are."""

from pathlib import Path

import pytest

from common import topics
from common.application import find_application
from common.config import load_cell
from common.messages import GripperState, WorldObjects
from common.transport.codec import decode
from lab.simulation import Simulation
from tests.harness import until

CUP = ["robot=ur5_cup", "services.depth_camera.rate=1.0", "services.io={}",
       "io.signals={vacuum: {output: 0}, vacuum_ok: {input: 0}}",
       "robot.gripper.vacuum={output: vacuum, input: vacuum_ok}",
       "world.camera.width=320", "world.camera.height=240", "world.camera.fx=400", "world.camera.fy=400",
       "world.camera.cx=160", "world.camera.cy=120"]
ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data"


class Observer:
    """Takes the place of a trace: widths of the fingers while they held, and the last ground truth."""

    def __init__(self):
        self.widths = set()
        self.truth = WorldObjects()

    def add(self, raw, _now):
        if raw.key.endswith(topics.GRIPPER_STATE.key) and (state := decode(GripperState, raw.payload)).holding:
            self.widths.add(round(state.width, 3))
        elif raw.key.endswith(topics.SCENE_OBJECTS.key):
            self.truth = decode(WorldObjects, raw.payload)


@pytest.mark.slow
def test_boxes_are_grasped_at_their_narrow_sides_and_placed_in_the_container():
    observer = Observer()
    outcome = Simulation(load_cell(str(DATA / "boxes.yaml")), 2, trace=observer).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 2, 2), outcome
    where = {item.id: (item.state, item.container) for item in observer.truth.objects}
    assert where == {"along": ("contained", "tray"), "turned": ("contained", "tray"), "can": ("table", "")}
    assert observer.widths == {0.03}, "as wide as the box is across"


@pytest.mark.slow
def test_cup_driven_by_io_palletizes_also_when_the_io_service_dies_with_a_box_in_the_air():
    cell = load_cell(str(ROOT / "examples" / "palletize" / "cell.yaml"), CUP, seed=1)
    observer = Observer()

    async def visit(bus):
        await until(bus.reader(find_application(cell.application).status), lambda status: status.stage == "across")
        simulation.kill("io")
        motion = bus.reader(topics.MOTION_STATUS)
        held = await until(motion, lambda status: status.held_by == ["controller"])
        assert held.interlocks[0].reason.startswith("vacuum_ok is lost: ")

    simulation = Simulation(cell, 1, visit=visit, trace=observer)
    outcome = simulation.run()  # includes the truth check
    assert (outcome.state, outcome.done, outcome.restarts, outcome.crashes) == ("DONE", 8, {"io": 1}, []), outcome
    assert observer.widths == {0.04}


@pytest.mark.slow
def test_vacuum_that_never_comes_ends_the_task_with_that_reason_and_every_box_stays():
    broken = ["io.signals.broken={output: 1}", "io.options.behaviors={vacuum_ok: {follows: broken}}",
              "services.task.most_tries=2",
              "world.objects=[{id: a, shape: box, size: [0.05, 0.05], height: 0.05, x: 0.5, y: 0, color: [1, 0, 0]}]"]
    cell, observer = load_cell(str(ROOT / "examples" / "palletize" / "cell.yaml"), [*CUP, *broken], seed=1), Observer()
    outcome = Simulation(cell, 1, trace=observer).run()
    assert outcome.state == "ERROR" and outcome.message.endswith("vacuum_ok did not come within 1 s"), outcome
    assert {item.state for item in observer.truth.objects} == {"table"} and outcome.done == 0
