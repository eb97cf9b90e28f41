"""Decisions of the sorting task: two objects at once, a foreign body, and what is held after a restart."""

import math

import numpy as np
import pytest

from applications.sorting.choice import Option
from applications.sorting.contents import Contents
from applications.sorting.motions import Pick, grip_force, push_line, release
from applications.sorting.settings import Config, Memory, SortingView
from applications.sorting.steady import depth_below, steady
from applications.sorting.task import Sorting
from applications.sorting.topics import GraspCandidate, Heap, SeenObject, SortingStatus
from common import messages as m
from common.config import load_cell, service_config
from common.errors import ConfigError
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, tool_down
from common.tasks.stages import Grip, Move

HOME = [0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398]
NOW = 100.0  # [s]


def config(**parameters):
    cell = load_cell("sorting", [f"services.sorter.{name}={value}" for name, value in parameters.items()])
    return service_config(cell, "sorter", Config)


def thing(name, x, y=0.0, color="red"):
    return SeenObject(id=name, place="tray", center=m.Vector3(x=x, y=y, z=0.04), size=m.Vector3(x=0.04, y=0.03, z=0.03),
                      top=0.04, bottom=0.005, volume=4e-5, color_name=color)


A, B, C = thing("a", 0.50), thing("b", 0.55), thing("c", 0.65)


def grasp(name="a", x=0.5):
    pose = matrix_to_pose(tool_down(x, 0.0, 0.03))
    return GraspCandidate(id=f"{name}/0", object=name, pose=pose, approach=pose, width=0.03, opening=0.05, score=0.8,
                 proved=True, q_approach=HOME, q=HOME)


def view(objects, *, grasps=(), stamp=NOW, holding=False, foreign=(), q=HOME, at_home=True):
    solids = [m.CollisionObject(id=f"foreign_{k}", role="target", shape="box", dimensions=[0.1] * 3, kind="foreign",
                                pose=m.Pose(position=m.Vector3(x=0.5))) for k, _ in enumerate(foreign)]
    nanoseconds = round(stamp * 1e9)
    attached = [m.AttachedObject(link="panda_hand_tcp", object=m.CollisionObject(
        id="a", role="attached", shape="box", dimensions=[0.04, 0.03, 0.03], pose=m.Pose()))] if holding else []
    return SortingView(
        now=stamp + 0.1, q=list(q), tcp=matrix_to_pose(tool_down(0.45, 0.4, 0.3)), motion=m.MotionStatus(),
        gripper=m.GripperState(width=0.03 if holding else 0.08, holding=holding),
        scene=m.PlanningScene(header=m.Header(stamp=nanoseconds), settled=nanoseconds, objects=solids,
                              attached=attached),
        heap=Heap(header=m.Header(stamp=nanoseconds), at_home=at_home, objects=list(objects), grasps=list(grasps)))


def carrying(task):
    """Let a task carry the object a above its container, and return its pick."""
    cycle = Pick("a", options=[Option(grasp(), A, "left")], chosen=Option(grasp(), A, "left"), before=[A, B, C],
                 gripped=True)
    task._memory = Memory(attempts=1, thing=A, grasp=grasp(), container="left", before=[A, B, C])
    task._carried_since = NOW - 1.0
    return cycle


@pytest.fixture
def task():
    return Sorting(config(), SortingStatus(started=True), "test")


def test_two_objects_at_once_are_noticed_before_the_release_and_put_back_to_the_tray(task):
    cycle = carrying(task)
    stage = release(cycle, task.gripper)
    task.queue.append(stage)
    assert not task.may_start(stage, view([C], holding=True, stamp=NOW - 0.2))
    assert not cycle.checked and task.queue and task.status.held == "", "one image is no evidence"
    seen = view([C], holding=True)
    assert not task.may_start(stage, seen)
    assert (task.status.held, list(task.queue)) == ("two", []) and "a and b are missing" in task.status.last
    task.decide(seen)
    goal = task.queue[1].goal.pose.position
    assert [stage.name for stage in task.queue] == ["back", "lower", "release", "up", "home", "look"]
    assert abs(goal.x - 0.55) < 0.2 and abs(goal.y) < 0.2, "in the tray"
    task.succeeded(task.queue[2], view([C]))
    assert task.memory.done == 0 and task.memory.thing is None
    assert not task._choice.options(view([A], grasps=[grasp()]).heap, NOW, 60.0, 4), "the grasp is avoided"


def test_missing_object_that_one_image_does_not_confirm_is_no_second_one(task):
    cycle = carrying(task)
    stage = release(cycle, task.gripper)
    assert not task.may_start(stage, view([C], holding=True, stamp=NOW - 0.2))
    assert task.may_start(stage, view([B, C], holding=True)) and task.status.held == "one"


def arrived(name, x, color="red", tint=(1.0, 0.0, 0.0)):
    r, g, b = tint
    return thing(name, x, 0.45, color).model_copy(update={"place": "left", "color": m.Color(r=r, g=g, b=b)})


RED, BLUE = arrived("o7", 0.50), arrived("o8", 0.55, "blue", (0.0, 0.0, 1.0))


@pytest.mark.parametrize(("shown", "done", "two", "overlooked"), [
    ([RED], 1, 0, ""),
    ([RED, BLUE], 2, 1, "two at once: o7 (red), o8 (blue) arrived in left after 1 release; o8 belongs in right"),
    ([RED, arrived("o9", 0.58)], 2, 1, "two at once: o7 (red), o9 (red) arrived in left after 1 release"),
    ([RED, arrived("o9", 0.55)], 1, 0, ""),  # so near: may be one
])
def test_second_object_that_arrived_in_a_container_is_counted_and_reported(task, shown, done, two, overlooked):
    for stamp in (NOW - 4.0, NOW - 3.8):
        task.note(view([A, C], stamp=stamp))
    cycle = carrying(task)
    task._memory = task._memory.model_copy(update={"contents": {"left": Contents(), "right": Contents()}})
    stage = release(cycle, task.gripper)
    away = [0.5, *HOME[1:]]
    assert task.may_start(stage, view([B, C], holding=True, q=away))
    task.note(view([B, C, *shown], holding=True, q=away))
    task.succeeded(stage, view([B, C], q=away))
    for k in range(60):
        seen = view(shown, stamp=NOW + 1.0 + 0.2 * k)
        if not task.queue:
            task.decide(seen)
        task.note(seen)
    status = task.status
    assert (status.state, status.done, status.figures["two_at_once"]) == ("DONE", done, two)
    assert (task.memory.sorted, status.overlooked) == ({"left": done}, overlooked)
    assert ("1 more objects arrived" in status.message) is bool(two)
    assert status.held == ("two" if two else "one") and (overlooked or "a to left") == status.last


def test_container_is_looked_at_from_home_after_a_doubtful_release_before_the_next_pick(task):
    cycle = carrying(task)
    task._memory = task._memory.model_copy(update={"wider": "55 mm wide, not 30 mm"})
    stage = release(cycle, task.gripper)
    away = [0.5, *HOME[1:]]
    cell = [B, C, A.model_copy(update={"place": "left"})]
    grasps = [grasp("b", 0.55)]
    assert task.may_start(stage, view([B, C], holding=True, q=away))
    task.succeeded(stage, view([B, C], q=away))
    assert task.status.last == "a to left; may be two: 55 mm wide, not 30 mm"
    for k in range(30):
        if not task.queue:
            task.decide(view(cell, grasps=grasps, stamp=NOW + 0.2 * k, q=away))
    assert [each.name for each in task.queue] == ["home", "look"]
    task.queue.clear()
    for k in range(30, 40):
        seen = view(cell, grasps=grasps, stamp=NOW + 0.2 * k)
        if not task.queue:
            task.decide(seen)
        task.note(seen)
    assert task.queue[0].name == "approach" and not task.memory.doubt


def test_one_object_is_released_and_counted(task):
    cycle = carrying(task)
    stage = release(cycle, task.gripper)
    assert task.may_start(stage, view([B, C], holding=True)) and task.status.held == "one"
    task.succeeded(stage, view([B, C]))
    assert (task.memory.done, task.memory.sorted) == (1, {"left": 1})


def test_release_waits_for_a_picture_of_the_tray(task):
    cycle = carrying(task)
    assert not task.may_start(release(cycle, task.gripper), view([A, B, C], holding=True, stamp=NOW - 2.0))
    assert not cycle.checked


def test_empty_grasp_is_penalized_and_the_arm_looks_again(task):
    cycle = carrying(task)
    close = Grip("close", "GRASPING", cycle, width=0.0, holds=True)
    task.missed(close, view([A, B, C]))
    assert (task.status.held, task.memory.attempts, task.memory.outcomes) == ("empty", 2, {"empty": 1})
    assert [stage.name for stage in task.queue] == ["open", "retreat", "home", "look"]
    assert not task._choice.options(view([A], grasps=[grasp()]).heap, NOW, 60.0, 4)


def test_all_best_grasps_are_planned_at_once_and_the_reached_one_is_followed_up(task):
    for stamp in (NOW - 0.2, NOW):  # at rest: two images show the same
        task.decide(view([A, B], grasps=[grasp(), grasp("b", 0.55)], stamp=stamp))
    move = task.queue[0]
    assert isinstance(move, Move) and [len(goal.positions) for goal in move.goal.goals] == [7, 7]
    task.planned(move, m.PlanResponse(id="1", ok=True, goal_index=1))
    end = m.JointTrajectoryPoint(time_from_start=1.0, positions=HOME, velocities=[0.0] * 7, accelerations=[0.0] * 7)
    move.trajectory = m.JointTrajectory(joint_names=[f"joint_{k}" for k in range(7)], points=[end])
    task.note(view([A, B]))
    assert move.cycle.subject == "b"
    assert [stage.name for stage in task.queue] == ["open", "approach", "descend", "close", "carry", "release"]


def test_task_with_a_foreign_body_and_nothing_to_grasp_waits_and_says_where_it_is(task):
    for k in range(60):
        task.decide(view([A], stamp=NOW + 0.2 * k, foreign=["hand"]))
    assert task.status.state == "IDLE" and not task.queue
    assert task.status.message == "waiting: a foreign body is in the cell at (0.50, 0.00)"


def test_heap_without_grasps_is_stirred_after_a_while(task):
    for k in range(20):
        task.decide(view([A], stamp=NOW + 0.2 * k))
    assert not task.queue
    for k in range(20, 30):
        if not task.queue:
            task.decide(view([A], stamp=NOW + 0.2 * k))
    assert [stage.name for stage in task.queue] == ["shut", "above", "down", "push", "up", "home", "open", "look"]


@pytest.mark.parametrize(("after", "held", "stages"), [
    ([B, C], "one", ["across", "release"]),
    ([C], "two", ["back", "lower", "release", "up", "home", "look"]),
])
def test_object_held_after_a_restart_is_compared_with_the_picture_before_its_grasp(task, after, held, stages):
    task.remember(Memory(attempts=3, done=2, thing=A, grasp=grasp(), container="right", before=[A, B, C]))
    task.decide(view([B, C], holding=True))
    assert not task.queue and "is one object held, or two?" in task.status.message, "that picture may be older"
    task.decide(view(after, holding=True, stamp=NOW + 1.0))
    if held == "two":
        assert not task.queue, "one image is no evidence"
        task.decide(view(after, holding=True, stamp=NOW + 1.2))
    assert task.status.held == held and [stage.name for stage in task.queue] == stages
    assert (task.queue[0].goal.pose.position.y < -0.2) == (held == "one"), "in the container of the memory"


def test_object_that_was_compared_before_a_restart_goes_where_the_memory_says(task):
    task.remember(Memory(thing=A, grasp=grasp(), container="right", before=[A, B, C], checked=True))
    task.decide(view([B, C], holding=True))
    assert task.queue[0].goal.pose.position.y < -0.2 and task.queue[-1].name == "release"


def test_held_object_that_no_memory_knows_goes_back_to_the_tray(task):
    task.decide(view([B, C], holding=True))
    assert [stage.name for stage in task.queue] == ["back", "lower", "release", "up", "home", "look"]
    assert "goes back to the tray" in task.status.message


def test_object_held_low_in_the_tray_after_a_restart_is_lifted_first(task):
    seen = view([A, B], holding=True, q=[0.3, *HOME[1:]])
    seen.tcp = matrix_to_pose(tool_down(0.55, 0.0, 0.03))
    task.decide(seen)
    assert [stage.name for stage in task.queue] == ["lift"]


def test_tray_that_cannot_be_seen_above_the_container_is_seen_from_home_before_the_release(task):
    cycle = carrying(task)
    stage = release(cycle, task.gripper)
    task.queue.append(stage)
    for k in range(30):
        hidden = view([], holding=True, stamp=NOW + 0.1 * k, at_home=False)
        if list(task.queue) == [stage]:
            assert not task.may_start(stage, hidden)
    assert [each.name for each in task.queue] == ["home", "look"] and not task.memory.checked


def test_tray_without_depth_is_not_called_empty(task):
    for k in range(40):
        seen = view([], stamp=NOW + 0.2 * k)
        seen.heap.hidden = 0.9
        task.decide(seen)
    assert (task.status.state, task.status.message) == ("ERROR", "no depth of 90 % of the tray")


@pytest.mark.parametrize(("inside", "done", "outcome"), [(0, 1, "one"), (1, 0, "slipped")])
def test_object_that_is_gone_after_a_restart_was_released_if_its_container_has_one_more(task, inside, done, outcome):
    task.remember(Memory(attempts=1, thing=A, grasp=grasp(), container="left", inside=inside, left=2))
    task.decide(view([B, A.model_copy(update={"place": "left"})]))
    assert (task.memory.done, task.status.held, task.memory.thing) == (done, outcome, None)
    assert bool(task._choice.failures) is (outcome == "slipped")


def test_noise_that_few_images_show_is_no_object():
    assert [each.id for each in steady([[A], [A, B], [A], [A, C]])] == ["a"]


@pytest.mark.parametrize(("volume", "force"), [(0.0, 30.0), (3e-5, 35.0), (6e-5, 40.0), (1.0, 40.0)])
def test_grip_force_grows_with_the_volume(volume, force):
    assert grip_force(volume, 70.0) == pytest.approx(force) and grip_force(volume, 30.0) <= 30.0


def test_push_starts_behind_the_object_and_ends_towards_the_middle_within_the_tray():
    start, end = push_line(thing("a", 0.64, 0.0), (0.55, 0.0), 0.16, 0)
    assert start == pytest.approx((0.69, 0.0)) and end == pytest.approx((0.54, 0.0))


def test_object_at_a_wall_is_pushed_along_it_from_where_the_tool_has_room():
    for attempt in range(2):
        start, end = push_line(thing("a", 0.55, 0.178), (0.55, 0.0), 0.165, attempt)
        assert max(abs(start[0] - 0.55), abs(start[1]), abs(end[0] - 0.55), abs(end[1])) <= 0.165 + 1e-9
        assert abs(end[0] - start[0]) > 0.08, "along the wall"
        assert min(start[1], end[1]) > 0.12, "through the object"


@pytest.mark.parametrize(("parameters", "text"), [
    ({"by": "weight"}, "services.sorter: by: 'weight' is no rule; choices: color, size, shape, or module:function"),
    ({"tray": "bin"}, "services.sorter: tray: 'bin' is no container; choices: tray, left, right"),
    ({"where": "{red: bin}"}, "where.red: 'bin' is no destination; choices: left, right"),
])
def test_bad_parameters_are_one_line(parameters, text):
    with pytest.raises(ConfigError) as error:
        config(**parameters)
    assert text in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("tilt", "below"), [(0.0, 0.015), (30.0, 0.02 * 0.5 + 0.015 * 3**0.5 / 2)])
def test_object_held_tilted_reaches_farther_below_the_tool(tilt, below):
    T = np.eye(4)
    T[:3, :3] = rpy_to_matrix(0.0, math.radians(tilt), 0.0)
    held = m.CollisionObject(
        id="a", role="attached", shape="prism", dimensions=[0.03], pose=matrix_to_pose(T),
        outline=[(x, y) for x in (-0.02, 0.02) for y in (-0.01, 0.01)])
    assert depth_below(held) == pytest.approx(below)


def test_rate_after_a_restart_includes_the_time_before_it(task):
    task.remember(Memory(attempts=9, done=9, seconds=170.0))
    task.status.task_seconds = 10.0
    task.note(view([A]))
    assert task.status.figures["picks_per_hour"] == 180.0
