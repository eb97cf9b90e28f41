"""A hidden table is not an empty one: complete cells with the arm in the image, a covered camera, or depth."""

from pathlib import Path

import pytest

from tests.simulated.visited import SimulatedCell

ARM = "services.camera_simulator.draw_robot=true"
SIDE = ["world.camera.position=[1.15,0,0.85]", "world.camera.rpy=[-2.4,0,1.5708]"]
COVERED = "services.camera_simulator.brightness=-255"


@pytest.mark.slow
def test_balls_occluded_by_the_arm_are_found_by_moving_it() -> None:
    cell = SimulatedCell("panda", [ARM, "world.balls=[[0.3,0.0]]", "services.camera_simulator.rate=5"])
    assert (cell.outcome.state, cell.outcome.done) == ("DONE", 1), cell.outcome
    assert "hides" in cell.text and "it is not known to be empty" in cell.text


def test_task_with_a_covered_camera_never_ends_done() -> None:
    summary = SimulatedCell("panda", [COVERED, "services.smart_pick_place.look_timeout=3"]).summary
    assert (summary["state"], summary["placed"]) == ("ERROR", 0)


@pytest.mark.slow
@pytest.mark.parametrize("place", [[], pytest.param(SIDE, marks=pytest.mark.campaign)], ids=["above", "side"])
@pytest.mark.parametrize(("count", "seed"), [
    (2, 1), *(pytest.param(7, seed, marks=pytest.mark.campaign) for seed in (1, 2))])
def test_table_is_cleared_with_the_arm_in_the_image(place: list[str], count: int, seed: int) -> None:
    summary = SimulatedCell("panda", [ARM, f"world.count={count}", *place], seed=seed).summary
    assert (summary["state"], summary["placed"], summary["targets"], summary["failures"]) == ("DONE", count, count, 0)
    assert summary["truth"]["in_box"] == count


@pytest.mark.slow
def test_table_is_cleared_by_color_and_depth() -> None:
    cell = Path(__file__).parents[1] / "data" / "depth_balls.yaml"
    summary = SimulatedCell(cell, ["world.count=2"]).summary
    assert (summary["state"], summary["placed"], summary["failures"]) == ("DONE", 2, 0), summary
    assert summary["truth"]["in_box"] == 2
