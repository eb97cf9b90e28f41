"""Clocks of several hosts: pictures from the future start no motion, and a motion that came too late is no failure."""

from __future__ import annotations

import pytest

from common import messages as m
from common.tasks.stages import ImageAge
from tests.applications.outlining.outline_double import OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble

AHEAD = "the camera's clock is 1.3 s ahead"


def motions(cell: CellDouble | OutlineDouble) -> list[m.Message]:
    return [request for request in cell.requests if isinstance(request, m.ExecuteRequest)]


@pytest.mark.parametrize(("stamp", "problem"), [
    (100.0, ""), (99.1, ""), (98.9, "no fresh picture"), (100.15, ""), (101.3, AHEAD)
])
def test_images_are_checked_for_age_and_future_stamps(stamp: float, problem: str) -> None:
    assert ImageAge(1.0).problem(100.0, (stamp,), 1.0, 0.2) == problem


def test_tolerances_are_wall_time_whatever_the_speed() -> None:
    pictures = ImageAge(5.0)
    assert pictures.problem(100.0, (95.5, 100.9), 1.0, 0.2) == ""
    assert pictures.problem(100.0, (94.9, 100.0), 1.0, 0.2) == "no fresh picture"
    assert pictures.problem(100.0, (100.0, 106.5), 1.0, 0.2) == AHEAD


def test_small_changes_of_clock_skew_keep_the_message() -> None:
    pictures = ImageAge(1.0)
    assert len({pictures.problem(100.0, (101.3 + 0.02 * (k % 5),), 1.0, 0.2) for k in range(20)}) == 1


def test_picking_waits_for_a_camera_clock_that_is_ahead() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.camera_ahead = 1.3
    for _ in range(100):
        cell.step()
    assert motions(cell) == [] and cell.task.status.message == AHEAD
    cell.camera_ahead = 0.1
    cell.until("DONE")
    assert cell.contained == 1


def test_wrong_clock_after_planning_prevents_the_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])
    plan = cell.unplannable

    def step_ahead(request: m.PlanRequest) -> str:
        cell.camera_ahead = 1.3
        return plan(request)

    cell.unplannable = step_ahead
    for _ in range(100):
        cell.step()
    assert motions(cell) == [] and AHEAD in cell.task.status.message
    cell.unplannable, cell.camera_ahead = plan, 0.0
    cell.step()
    assert len(motions(cell)) == 1 and cell.task.status.message == "", "what it waited for is over"
    cell.until("DONE")
    assert cell.contained == 1


def test_outlining_waits_for_a_camera_clock_that_is_ahead() -> None:
    cell = OutlineDouble(selection_timeout=0.0)
    cell.camera_ahead = 1.3
    for _ in range(100):
        cell.step()
    assert motions(cell) == [] and cell.status.message == AHEAD
    cell.camera_ahead = 0.0
    cell.until("DONE")


def test_picking_decides_again_after_a_late_request() -> None:
    cell = CellDouble([(0.40, -0.30), (0.50, -0.30)])
    for _ in range(12):  # more than the failures in a row that are borne
        cell.late = 1
        while cell.late:
            cell.step()
    cell.until("DONE")
    assert cell.contained == 2 and cell.task.status.failures == 0


def test_outlining_starts_again_after_a_late_request() -> None:
    cell = OutlineDouble()
    cell.late = 2
    cell.until("DONE")
    assert cell.status.closed and cell.status.failures == 0
