"""Boxes that a camera saw are gripped by their narrow sides and put into the container, as balls are."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest

from common import topics
from common.config import Cell, load_cell
from common.messages import GripperState, WorldObjects
from common.transport.codec import decode
from common.transport.session import RawSample
from lab.observers import Trace
from lab.simulation import Simulation

CELL = """
cell: boxes
robot: panda
pipeline: cartesian_ompl
application: pick_place
world:
  fixtures:
    - {id: table, dimensions: [1.0, 1.0, 0.05], position: [0.5, 0.0, -0.025], color: [0.55, 0.35, 0.10]}
  containers: {tray: {x: 0.55, y: 0.25}}
  objects:
    - {id: along, shape: box, size: [0.05, 0.03, 0.03], x: 0.45, y: -0.10, color: [0.1, 0.2, 1.0]}
    - {id: turned, shape: box, size: [0.05, 0.03, 0.03], x: 0.38, y: 0.03, yaw: 0.6, color: [0.1, 0.2, 1.0]}
    - {id: can, shape: cylinder, radius: 0.02, height: 0.05, x: 0.6, y: -0.2, color: [0.0, 0.7, 0.2]}
services:
  motion_planner: {}
  robot_state_publisher: {}
  trajectory_executor: {}
  camera_simulator: {}
  tests.simulated.box_detector: {}
  workspace_validator: {}
  scene_manager: {}
  smart_pick_place: {}
"""


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    path = tmp_path / "boxes.yaml"
    path.write_text(CELL, encoding="utf-8")
    return load_cell(str(path))


class Observer:
    """Takes the messages of a run in the place of a trace: how wide the fingers held, and the truth as it was last."""

    def __init__(self) -> None:
        self.widths: set[float] = set()
        self.truth = WorldObjects()

    def add(self, raw: RawSample, _now: int) -> None:
        if raw.key.endswith(topics.GRIPPER_STATE.key) and (state := decode(GripperState, raw.payload)).holding:
            self.widths.add(round(state.width, 3))
        elif raw.key.endswith(topics.SCENE_OBJECTS.key):
            self.truth = decode(WorldObjects, raw.payload)


@pytest.mark.slow
def test_boxes_are_grasped_at_their_narrow_sides_and_placed_in_the_container(cell: Cell) -> None:
    observer = Observer()
    outcome = Simulation(cell, 2, trace=cast(Trace, observer)).run()
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 2, 2), outcome
    where = {item.id: (item.state, item.container) for item in observer.truth.objects}
    assert where == {"along": ("contained", "tray"), "turned": ("contained", "tray"), "can": ("table", "")}
    assert observer.widths == {0.03}, "as wide as the box is across"
