"""Objects that a task detected but did not grasp are reported; unexplained ones fail the run."""

import pytest

from tests.harness import RunningCell
from tests.simulated.visited import SimulatedCell

LEAST = "services.vision_detector.min_contour_area_px"


def test_balls_below_the_minimum_area_are_reported_as_left() -> None:
    summary = SimulatedCell("panda", ["world.count=2", f"{LEAST}=3000"]).summary
    assert (summary["state"], summary["placed"]) == ("DONE", 0)
    assert summary["overlooked"] == ("the table looks empty, but 2 red blobs are smaller than "
                                     "vision_detector.min_contour_area_px = 3000")
    assert summary["unexplained"] == [[0.4, -0.3, 0.03], [0.52, -0.3, 0.03]]


@pytest.mark.slow
@pytest.mark.cell
async def test_run_with_unexplained_objects_warns_and_exits_3(tmp_path) -> None:
    with RunningCell(tmp_path, "run", "panda", "--set", "world.count=1", "--set", f"{LEAST}=3000") as cell:
        assert await cell.ended(120.0) == 3
    assert "error: world.objects: ball_1 appears on" in cell.text
    assert "left at (0.400, -0.300, 0.030): not reported by the task" in cell.text
