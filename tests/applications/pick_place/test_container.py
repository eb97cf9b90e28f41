"""Where balls are let go above the container, and which of those in it count as placed."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.choice import Pick
from applications.pick_place.grasping import Target
from applications.pick_place.motion_sequences import MotionSequences
from common import messages as m
from tests.applications.pick_place.cell_double import SEVEN, CellDouble


def test_nothing_is_let_go_above_what_leans_on_others_and_looks_as_if_it_lay_on_the_floor() -> None:
    cell = CellDouble([(0.40, -0.30)])
    choice = cell.task._choice
    cell.fell = [(x, y, 0.035) for x in (0.526, 0.574) for y in (0.226, 0.274)]
    cell.contained = len(cell.fell)
    pick = choice.next(cell.view(), (0.4, -0.3), [])
    assert pick is not None and pick.over is not None
    cell.tcp = (*pick.over, 0.225)
    choice.released(pick, cell.view())
    cell.fell.append((*pick.over, 0.035))
    restarted = CellDouble([(0.40, -0.30)]).task
    restarted.remember(type(cell.task.memory).model_validate_json(cell.task.memory.model_dump_json()))
    begun = cell.view()  # of a scene manager that was started again too, and has seen nothing yet
    begun.scene = m.PlanningScene(header=m.Header(stamp=0))
    assert restarted._choice.held("track_1", begun).over != pick.over
    for contained, same in ((5, False), (0, False), (0, True)):  # then somebody empties the container
        cell.now, cell.contained = cell.now + 10.0, contained
        for one in (choice, restarted._choice):
            after = one.next(cell.view(), (0.4, -0.3), [])
            assert after is not None and (after.over == pick.over) == same


def test_what_a_task_finds_in_the_hand_as_it_is_started_again_is_let_go_where_there_is_most_room() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("across")
    again = CellDouble([])
    again.held, again.gripper, again.tcp = cell.held, cell.gripper, cell.tcp
    again.fell = [(x, y, 0.035) for x, y in ((0.526, 0.226), (0.526, 0.274), (0.574, 0.226))]
    again.contained = len(again.fell)
    again.until("across")
    asked = next(r for r in again.requests if isinstance(r, m.PlanRequest) and r.stage == "across")
    assert isinstance(asked.goal, m.PoseGoal)
    place, tolerance = asked.goal.pose.position, asked.goal.position_tolerance
    assert place.x - tolerance.x / 2 >= 0.55 and place.y - tolerance.y / 2 >= 0.25


def test_balls_are_let_go_above_the_columns_in_which_least_lies() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30), (0.40, -0.17), (0.52, -0.17), (0.64, -0.13)])
    cell.until("DONE")
    ends = [plan.goal.items[1].goal for plan in cell.requests
            if isinstance(plan, m.PlanRequest) and plan.stage == "across" and isinstance(plan.goal, m.SequenceGoal)]
    assert all(isinstance(end, m.PoseGoal) and end.position_tolerance.x == pytest.approx(0.03) for end in ends)
    columns = [(round(end.pose.position.x, 3), round(end.pose.position.y, 3)) for end in ends
               if isinstance(end, m.PoseGoal)]
    assert set(columns[:4]) == {(0.526, 0.226), (0.526, 0.274), (0.574, 0.226), (0.574, 0.274)}
    assert columns[0] == (0.526, 0.226)  # the nearest to where the first ball lay
    box = cell.task.p.world.container
    for end in ends:
        assert isinstance(end, m.PoseGoal)
        off = max(abs(end.pose.position.x - box.x), abs(end.pose.position.y - box.y)) + end.position_tolerance.x / 2
        assert off + cell.task.p.world.ball_radius < box.half_side - box.wall_thickness, "it falls clear of the walls"


@given(st.floats(0.005, 0.08), st.floats(0.01, 0.2), st.booleans())
def test_what_is_let_go_above_a_column_falls_clear_of_the_walls_however_large_it_is(
    radius: float, wide: float, flat: bool,
) -> None:
    task = CellDouble([], place_pos_tol=wide).task
    sequences, box = MotionSequences(task.p, task.gripper), task.p.world.container
    size = (math.sqrt(2) * radius, math.sqrt(2) * radius) if flat else None
    over = box.x + box.slot_offset, box.y - box.slot_offset
    goal = sequences.across(Pick(target=Target("t", (0.4, -0.3, 0.03), radius, size), over=over), 0.0).goal
    assert isinstance(goal, m.PoseGoal)
    at, side = goal.pose.position, goal.position_tolerance
    inside = box.half_side - box.wall_thickness
    for off, about in ((abs(at.x - box.x), side.x), (abs(at.y - box.y), side.y)):
        assert off + about / 2 + radius < inside or off == 0.0, "unless there is no such place"


def _side(goal: m.AnyGoal) -> float:
    end = goal.items[-1].goal if isinstance(goal, m.SequenceGoal) else goal
    assert isinstance(end, m.PoseGoal)
    return end.position_tolerance.x


def test_where_there_is_no_way_to_the_emptiest_column_a_ball_is_let_go_anywhere_above_the_container() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.unplannable = lambda request: (  # noqa: E731 - as the double has it
        "no way" if request.stage == "across" and _side(request.goal) == pytest.approx(0.03) else "")
    cell.until("DONE")
    assert cell.contained == 1
    last = [r for r in cell.requests if isinstance(r, m.PlanRequest) and r.stage == "across"][-1]
    assert isinstance(last.goal, m.PoseGoal) and last.goal.pose.position.x == pytest.approx(0.55)
    assert _side(last.goal) == pytest.approx(0.06)


def test_ninth_ball_is_reported_because_the_container_is_full() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.contained = 8
    cell.until("DONE")
    assert cell.contained == 8
    assert cell.task.status.skipped[0].reason == "the container is full"


def test_balls_are_taken_again_once_the_container_is_emptied_and_nothing_on_the_table_has_changed() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.contained = 8
    cell.until("DONE")
    cell.contained = 0
    cell.until("pre-grasp")
    assert not cell.task.status.skipped
    cell.until("DONE")
    assert cell.contained == 1


@pytest.mark.parametrize("late", [0, 5, 15])
def test_after_a_restart_what_lies_in_the_container_counts_as_placed_however_late_it_is_seen(late: int) -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.restart()
    cell.contained, contained = 0, 6  # as a scene manager says that was started again as well
    for _ in range(late):
        cell.step()
    cell.contained += contained
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed, cell.task.status.targets) == (7, 7, 7)


@pytest.mark.parametrize("stage", ["pre-grasp", "lift", "across", "release"])
def test_every_ball_counts_once_when_the_task_was_started_again_in_any_stage(stage: str) -> None:
    cell = CellDouble(SEVEN, joined=stage != "lift")
    cell.until("release")
    cell.until("pre-grasp")
    if stage != "pre-grasp":
        cell.until(stage)
    cell.restart()
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed, cell.task.status.targets) == (7, 7, 7)


def test_what_must_carry_what_is_seen_counts_until_the_task_has_put_a_ball_there_itself() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    cell.contained, cell.beneath = 1, 1
    cell.until("close")
    assert cell.task.status.placed == 2
    cell.until("release")
    cell.until("pre-grasp")
    cell.beneath = 3  # a ball rolls off one and lies above the place of another
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed) == (3, 4)


def test_container_is_not_full_of_balls_that_nobody_sees_nor_has_put_there() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    cell.until("release")
    cell.beneath = 7
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed) == (2, 2)


def test_what_is_seen_in_the_container_for_a_moment_only_does_not_count() -> None:
    cell = CellDouble([(0.40, -0.30)])
    for k in range(300):
        cell.contained += {10: 3, 12: -3}.get(k, 0)
        cell.step()
    assert (cell.contained, cell.task.status.placed) == (1, 1)


def test_ball_that_hangs_over_the_container_while_it_is_let_go_counts_once() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("across")
    asked: list[m.GripperCommand] = []
    cell._grip = asked.append
    cell.until("release")
    cell.contained = 2  # one above the other, as a picture shows it while the fingers open
    for _ in range(20):
        cell.step()
    del cell._grip
    cell._grip(asked[-1])
    cell.contained = 2  # as the picture before still says
    cell.step()
    cell.contained = 1
    cell.until("DONE")
    assert (cell.task.status.placed, cell.task.status.targets) == (1, 1)


def until_fingers_open(cell: CellDouble) -> None:
    """Until they have been told to above the container, and the arm has not arrived."""
    cell.until("across")
    until_fingers_move(cell)
    assert cell.task.status.stage == "across"


def until_fingers_move(cell: CellDouble) -> None:
    """Before the arm stands."""
    for _ in range(10):
        cell.step()
        if cell._fingers is not None:
            return
    raise AssertionError("they did not begin")


def test_ball_that_was_let_go_a_moment_before_a_pause_counts_once() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    until_fingers_open(cell)
    cell.tell("pause")
    for _ in range(20):
        cell.step()
        assert cell.task.status.targets == 2
    assert cell.contained == 1 and cell.task.status.stage == "across"
    cell.tell("resume")
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed, cell.task.status.targets) == (2, 2, 2)


def test_ball_that_was_let_go_a_moment_before_a_stop_counts_though_it_hides_another() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    cell.until("release")
    cell.until("pre-grasp")
    until_fingers_open(cell)
    cell.tell("stop")
    for _ in range(20):
        cell.step()
        cell.contained = min(cell.contained, 1)  # the other one is not seen any more
    cell.tell("start")
    cell.until("DONE")
    assert (cell.task.status.placed, cell.task.status.targets) == (2, 2)


def test_ball_that_was_taken_a_moment_before_a_pause_is_one_of_those_to_be_placed() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    cell.until("pre-grasp")
    until_fingers_move(cell)
    assert cell.task.status.stage == "pre-grasp"
    cell.tell("pause")
    for _ in range(20):
        cell.step()
        assert cell.task.status.targets == 2
    assert cell.held and cell.task.status.stage == "pre-grasp"
