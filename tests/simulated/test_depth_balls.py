"""The cell with balls and a camera with depth in the place of the other one."""

from pathlib import Path

import pytest

from tests.simulated.visited import SimulatedCell

CELL = """
cell: panda
robot: panda
world: balls
pipeline: cartesian_ompl
application: pick_place
services:
  motion_planner: {}
  robot_state_publisher: {}
  trajectory_executor: {}
  depth_camera: {rate: 5.0, topics: {depth_camera/image_raw: camera/image_raw,
                                     depth_camera/camera_info: camera/camera_info}}
  vision_detector: {depth: true}
  workspace_validator: {}
  scene_manager: {}
  smart_pick_place: {}
"""


@pytest.mark.slow
def test_table_is_cleared_by_color_and_depth(tmp_path: Path) -> None:
    path = tmp_path / "depth.yaml"
    path.write_text(CELL, encoding="utf-8")
    summary = SimulatedCell(str(path), ["world.count=3"]).summary
    assert (summary["state"], summary["placed"], summary["failures"]) == ("DONE", 3, 0), summary
    assert summary["truth"]["in_box"] == 3
