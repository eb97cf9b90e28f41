"""Release positions above the container, and which balls in it count as placed."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.choice import Pick
from applications.pick_place.grasping import Target
from applications.pick_place.motion_sequences import MotionSequences
from common import messages as m
from tests.applications.pick_place.cell_double import SEVEN, CellDouble

ONE, TWO = [(0.40, -0.30)], [(0.40, -0.30), (0.52, -0.30)]
COLUMNS = [(0.526, 0.226), (0.526, 0.274), (0.574, 0.226), (0.574, 0.274)]


def on_floor(columns: list[tuple[float, float]]) -> list[tuple[float, float, float]]:
    return [(x, y, 0.035) for x, y in columns]


def assert_counted(cell: CellDouble, count: int) -> None:
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed, cell.task.status.targets) == (count, count, count)


def test_no_release_above_a_leaning_ball_that_looks_like_one_on_the_floor() -> None:
    cell = CellDouble(ONE)
    choice = cell.task._choice
    cell.fell = on_floor(COLUMNS)
    cell.contained = len(cell.fell)
    pick = choice.next(cell.view(), (0.4, -0.3), [])
    cell.tcp = (*pick.over, 0.225)
    choice.released(pick, cell.view())
    cell.fell.append((*pick.over, 0.035))
    restarted = CellDouble(ONE).task
    restarted.remember(type(cell.task.memory).model_validate_json(cell.task.memory.model_dump_json()))
    initial = cell.view()  # of a restarted scene manager without images
    initial.scene = m.PlanningScene(header=m.Header(stamp=0))
    assert restarted._choice.held("track_1", initial).over != pick.over
    for contained, same in ((5, False), (0, False), (0, True)):  # then the container is emptied
        cell.now, cell.contained = cell.now + 10.0, contained
        for one in (choice, restarted._choice):
            assert (one.next(cell.view(), (0.4, -0.3), []).over == pick.over) == same


def test_held_object_after_a_restart_is_released_above_the_lowest_column() -> None:
    cell = CellDouble(ONE)
    cell.until("across")
    restarted = CellDouble([])
    restarted.held, restarted.gripper, restarted.tcp = cell.held, cell.gripper, cell.tcp
    restarted.fell = on_floor(COLUMNS[:3])
    restarted.contained = len(restarted.fell)
    restarted.until("across")
    goal = next(plan.goal for plan in restarted.plans() if plan.stage == "across")
    place, tolerance = goal.pose.position, goal.position_tolerance
    assert place.x - tolerance.x / 2 >= 0.55 and place.y - tolerance.y / 2 >= 0.25


def test_balls_are_released_above_the_lowest_columns() -> None:
    cell = CellDouble([*TWO, (0.40, -0.17), (0.52, -0.17), (0.64, -0.13)])
    cell.until("DONE")
    ends = [plan.goal.items[1].goal for plan in cell.plans() if plan.stage == "across"]
    assert all(end.position_tolerance.x == pytest.approx(0.03) for end in ends)
    columns = [(round(end.pose.position.x, 3), round(end.pose.position.y, 3)) for end in ends]
    assert set(columns[:4]) == set(COLUMNS)
    assert columns[0] == COLUMNS[0]  # the nearest to where the first ball lay
    world, box = cell.task.p.world, cell.task.p.world.container
    for end in ends:
        off = max(abs(end.pose.position.x - box.x), abs(end.pose.position.y - box.y)) + end.position_tolerance.x / 2
        assert off + world.ball_radius < box.half_side - box.wall_thickness, "it falls clear of the walls"


@given(st.floats(0.005, 0.08), st.floats(0.01, 0.2), st.booleans())
def test_released_object_of_any_size_falls_clear_of_the_walls(radius: float, wide: float, flat: bool) -> None:
    task = CellDouble([], place_pos_tol=wide).task
    sequences, box = MotionSequences(task.p, task.gripper), task.p.world.container
    size = (math.sqrt(2) * radius, math.sqrt(2) * radius) if flat else None
    over = box.x + box.slot_offset, box.y - box.slot_offset
    goal = sequences.across(Pick(target=Target("t", (0.4, -0.3, 0.03), radius, size), over=over), 0.0).goal
    at, side = goal.pose.position, goal.position_tolerance
    inside = box.half_side - box.wall_thickness
    for off, width in ((abs(at.x - box.x), side.x), (abs(at.y - box.y), side.y)):
        assert off + width / 2 + radius < inside or off == 0.0, "unless there is no such place"


def test_ball_is_released_anywhere_if_the_lowest_column_is_unreachable() -> None:
    def side(goal: m.AnyGoal) -> float:
        return (goal.items[-1].goal if isinstance(goal, m.SequenceGoal) else goal).position_tolerance.x

    cell = CellDouble(ONE)
    cell.unplannable = lambda r: "no way" if r.stage == "across" and side(r.goal) == pytest.approx(0.03) else ""
    cell.until("DONE")
    assert cell.contained == 1
    last = [plan.goal for plan in cell.plans() if plan.stage == "across"][-1]
    assert last.pose.position.x == pytest.approx(0.55) and side(last) == pytest.approx(0.06)


def test_ninth_ball_is_skipped_until_the_full_container_is_emptied() -> None:
    cell = CellDouble(ONE)
    cell.contained = 8
    cell.until("DONE")
    assert cell.contained == 8 and cell.task.status.skipped[0].reason == "the container is full"
    cell.contained = 0
    cell.until("pre-grasp")
    assert not cell.task.status.skipped
    cell.until("DONE")
    assert cell.contained == 1


@pytest.mark.parametrize("late", [0, 5, 15])
def test_objects_in_the_container_count_after_a_restart(late: int) -> None:
    cell = CellDouble(ONE)
    cell.restart()
    cell.steps(late)  # a scene manager that was restarted as well has not seen them yet
    cell.contained += 6
    assert_counted(cell, 7)


@pytest.mark.parametrize("stage", ["pre-grasp", "lift", "across", "release"])
def test_every_ball_counts_once_after_a_restart_in_any_stage(stage: str) -> None:
    cell = CellDouble(SEVEN, joined=stage != "lift")
    cell.until("release")
    cell.until("pre-grasp")
    if stage != "pre-grasp":
        cell.until(stage)
    cell.restart()
    assert_counted(cell, 7)


@pytest.mark.parametrize("beneath", [3, 7])  # a ball rolls off one and lies above the places of others
def test_supporting_balls_count_until_the_task_has_placed_one(beneath: int) -> None:
    cell = CellDouble(TWO)
    cell.contained, cell.beneath = 1, 1
    cell.until("close")
    assert cell.task.status.placed == 2
    cell.until("release")
    cell.until("pre-grasp")
    cell.beneath = beneath
    cell.until("DONE")
    assert (cell.contained, cell.task.status.placed) == (3, 4)


def test_balls_seen_above_the_container_for_a_moment_do_not_count() -> None:
    cell = CellDouble(ONE)
    cell.steps(4)
    for seen in (3, 3, 0):
        cell.contained = seen
        cell.step()
    cell.until("across")
    commands: list[m.GripperCommand] = []
    cell._close_or_open = commands.append
    cell.until("release")
    cell.contained = 2  # one above the other, as an image shows it while the fingers open
    cell.steps(20)
    del cell._close_or_open
    cell._close_or_open(commands[-1])
    cell.contained = 2  # in the previous image
    cell.step()
    cell.contained = 1
    assert_counted(cell, 1)


def until_fingers_move(cell: CellDouble, stage: str) -> None:
    """Step until the fingers move before the arm arrives."""
    cell.until(stage)
    for _ in range(10):
        cell.step()
        if cell._fingers is not None:
            assert cell.task.status.stage == stage
            return
    raise AssertionError("the fingers did not move early")


@pytest.mark.parametrize(("stage", "held", "contained"), [("across", False, 1), ("pre-grasp", True, 0)])
def test_ball_taken_or_released_just_before_a_pause_counts_once(stage: str, held: bool, contained: int) -> None:
    cell = CellDouble(TWO)
    until_fingers_move(cell, stage)
    cell.command("pause")
    for _ in range(20):
        cell.step()
        assert cell.task.status.targets == 2
    assert (bool(cell.held), cell.contained, cell.task.status.stage) == (held, contained, stage)
    cell.command("resume")
    assert_counted(cell, 2)


def test_ball_released_just_before_a_stop_counts_though_it_occludes_another() -> None:
    cell = CellDouble(TWO)
    cell.until("release")
    cell.until("pre-grasp")
    until_fingers_move(cell, "across")
    cell.command("stop")
    for _ in range(20):
        cell.step()
        cell.contained = min(cell.contained, 1)  # the other one is not seen any more
    cell.command("start")
    cell.until("DONE")
    assert (cell.task.status.placed, cell.task.status.targets) == (2, 2)
