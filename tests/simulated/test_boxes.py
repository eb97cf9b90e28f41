"""Boxes that a camera detects are gripped by their narrow sides and put into the container, as balls are."""

from pathlib import Path

import pytest

from common import topics
from common.config import load_cell
from common.messages import GripperState, WorldObjects
from common.transport.codec import decode
from lab.simulation import Simulation

DATA = Path(__file__).parents[1] / "data"


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
