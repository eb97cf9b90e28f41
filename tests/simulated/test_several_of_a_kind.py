"""A cell with two cameras and two detectors, each with its own name, that feed one scene."""

from pathlib import Path

import pytest

from common.config import load_cell
from common.supervision.wiring import owned_in, require_one_owner, wiring_of
from lab.observers import Trace
from lab.simulation import Simulation
from recording.capture import CustomTopics
from recording.reader import Recording

CELL = str(Path(__file__).parents[1] / "data" / "two_cameras.yaml")


@pytest.mark.slow
def test_two_cameras_clear_a_table_that_neither_sees_completely(tmp_path: Path) -> None:
    cell = load_cell(CELL)
    trace = Trace(tmp_path / "run.mcap", {"cell": cell.name}, CustomTopics.of(cell))
    outcome = Simulation(cell, 1, trace=trace).run()
    trace.close("simulated")
    with Recording(tmp_path / "run.mcap") as recording:
        kinds = {topic: kind for topic, (_, kind) in recording.topics().items()}
    assert {kinds[f"{side}/camera/camera_info"] for side in ("left", "right")} == {"state"}
    assert {kinds[f"{side}/camera/image_raw"] for side in ("left", "right")} == {"stream"}
    assert (outcome.state, outcome.done, outcome.total) == ("DONE", 3, 3), outcome
    assert outcome.crashes == [] and outcome.restarts == {}


@pytest.mark.slow
def test_task_is_not_done_while_one_of_two_cameras_is_silent() -> None:
    lost = "services.right_detector.topics={camera/*: nowhere/camera/*, detect*: right/detect*}"
    outcome = Simulation(load_cell(CELL, [lost, "services.smart_pick_place.look_timeout=3"]), 1).run()
    assert (outcome.state, outcome.done) == ("ERROR", 2), outcome
    assert "no image received from right, for 3 s" in outcome.message


def test_two_cameras_on_one_key_are_rejected_at_the_start() -> None:
    outcome = Simulation(load_cell(CELL, ["services.right_camera.topics={camera/*: left/camera/*}"]), 1).run()
    assert (outcome.state, outcome.message) == ("NOT STARTED", (
        "services.right_camera: left_camera has left/camera/camera_info already, and a key is written or "
        "served by one service: give right_camera or left_camera keys of its own, as in topics: "
        "{camera/*: right_camera/*}"))


async def test_keys_and_owners_follow_from_the_cell() -> None:
    cell = load_cell(CELL)
    wirings = {entry.name: await wiring_of(cell, entry) for entry in cell.services.values()}
    require_one_owner(wirings)
    owned = {key: services for key, (_, services) in owned_in(wirings).items()}
    for side in ("left", "right"):
        assert owned[f"{side}/camera/image_raw"] == owned[f"{side}/camera/camera_info"] == [f"{side}_camera"]
        assert owned[f"{side}/detected_objects"] == owned[f"{side}/detection_image"] == [f"{side}_detector"]
    assert "camera/image_raw" not in owned and "detected_objects" not in owned
    read = {topic.key for topic in wirings["scene_manager"].reads}
    assert {"left/detected_objects", "right/detected_objects", "left/camera/camera_info"} < read


CUP = "robot.gripper={cup: {}, links: [panda_hand, panda_leftfinger, panda_rightfinger]}"


@pytest.mark.parametrize("gripper", [CUP, pytest.param("robot.gripper.closing_axis=x", marks=pytest.mark.campaign)])
@pytest.mark.slow
def test_task_uses_the_gripper_of_the_robot_file(gripper: str) -> None:
    outcome = Simulation(load_cell("panda", ["world.count=1", gripper]), 1).run()
    assert (outcome.state, outcome.done, outcome.broken) == ("DONE", 1, []), outcome
