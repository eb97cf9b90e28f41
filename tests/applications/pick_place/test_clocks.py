"""Clocks of several hosts: images from the future start no motion, and a late request is no failure."""

import pytest

from common import messages as m
from common.tasks.stages import ImageAge
from tests.applications.outlining.outline_double import OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble

AHEAD = "the camera's clock is 1.3 s ahead"
Double = CellDouble | OutlineDouble


@pytest.fixture(params=["pick_place", "outline"])
def cell(request: pytest.FixtureRequest) -> Double:
    return CellDouble([(0.40, -0.30)]) if request.param == "pick_place" else OutlineDouble(selection_timeout=0.0)


def motions(cell: Double) -> int:
    return sum(isinstance(request, m.ExecuteRequest) for request in cell.requests)


@pytest.mark.parametrize(("limit", "stamps", "problem"), [
    (1.0, (100.0,), ""), (1.0, (99.1,), ""), (1.0, (98.9,), "no fresh picture"), (1.0, (100.15,), ""),
    (1.0, (101.3,), AHEAD),
    # With another speed of the cell: tolerances are wall time.
    (5.0, (95.5, 100.9), ""), (5.0, (94.9, 100.0), "no fresh picture"), (5.0, (100.0, 106.5), AHEAD),
])
def test_images_are_checked_for_age_and_future_stamps(limit: float, stamps: tuple[float, ...], problem: str) -> None:
    assert ImageAge(limit).problem(100.0, stamps, 1.0, 0.2) == problem


def test_small_changes_of_clock_skew_keep_the_message() -> None:
    images = ImageAge(1.0)
    assert len({images.problem(100.0, (101.3 + 0.02 * (k % 5),), 1.0, 0.2) for k in range(20)}) == 1


def test_task_waits_for_a_camera_clock_that_is_ahead(cell: Double) -> None:
    cell.camera_ahead = 1.3
    for _ in range(100):
        cell.step()
    assert motions(cell) == 0 and cell.task.status.message == AHEAD
    cell.camera_ahead = 0.0
    cell.until("DONE")


def test_wrong_clock_after_planning_prevents_the_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])

    def step_ahead(request: m.PlanRequest) -> str:
        cell.camera_ahead = 1.3
        return ""

    cell.unplannable = step_ahead
    cell.steps(100)
    assert motions(cell) == 0 and AHEAD in cell.task.status.message
    cell.unplannable, cell.camera_ahead = lambda request: "", 0.0
    cell.step()
    assert motions(cell) == 1 and cell.task.status.message == ""
    cell.until("DONE")


@pytest.mark.parametrize("late", [1, 12])  # more than the permitted failures in a row
def test_task_decides_again_after_a_late_request(cell: Double, late: int) -> None:
    for _ in range(late):
        cell.late = 1
        while cell.late:
            cell.step()
    cell.until("DONE")
    assert cell.task.status.failures == 0
    assert not isinstance(cell, OutlineDouble) or cell.status.closed
