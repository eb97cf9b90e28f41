"""Picking: the order of the balls, the requested motions, failed grasps, and the end of the task."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.choice import Pick
from applications.pick_place.grasping import Target, finger_clearance
from applications.pick_place.motion_sequences import MotionSequences
from common import messages as m
from common.robot.transforms import matrix_to_pose, matrix_to_rpy, pose_to_matrix, rpy_to_matrix, tool_down, transform
from common.tasks.stages import Move
from tests.applications.pick_place.cell_double import SEVEN, CellDouble

ONE, TWO = [(0.40, -0.30)], [(0.40, -0.30), (0.52, -0.30)]
THREE = [*TWO, (0.40, -0.17)]


def test_seven_balls_and_one_added_after_the_end_are_placed_in_the_container() -> None:
    cell = CellDouble(SEVEN)
    cell.until("DONE")
    assert (cell.contained, cell.balls, cell.task.status.placed, cell.task.status.failures) == (7, {}, 7, 0)
    cell.balls["added"] = (0.52, -0.04, 0.03)
    cell.until("GRASPING")
    cell.until("DONE")
    assert cell.contained == 8


def test_nearest_ball_is_taken_first() -> None:
    cell = CellDouble([(0.6, -0.2), (0.35, 0.0)])
    cell.until("pre-grasp")
    assert cell.task.status.target == "track_1"


def test_next_pick_is_planned_from_the_end_of_the_running_transfer() -> None:
    cell = CellDouble(TWO)
    cell.until("across")
    before = len(cell.stages())
    cell.step()
    assert cell.stages()[before:before + 1] == ["pre-grasp"] and cell.motion.state == "active"
    cell.until("DONE")
    assert [bool(plan.start) for plan in cell.plans()[:4]] == [False, True, True, True]


@pytest.mark.parametrize("rolling", [0, 13])  # steps in which it is seen
def test_ball_lost_for_good_is_reported_at_the_end(rolling: int) -> None:
    cell = CellDouble(THREE)
    cell.until("across")
    cell.drop()
    fallen = next(reversed(cell.balls))
    x, y, z = cell.balls[fallen]
    for step in range(rolling):
        cell.balls[fallen] = (x - 0.03 * step, y, z)
        cell.step()
    del cell.balls[fallen]
    cell.until("DONE")
    status = cell.task.status
    assert (status.done, status.total) == (2, 3)
    assert status.overlooked == (
        "the table looks empty, but 1 that was seen before something fell out of the hand was not seen again")


def test_recovered_ball_is_not_reported_even_if_another_is_removed() -> None:
    cell = CellDouble(THREE)
    cell.until("across")
    cell.drop()
    cell.until("close")
    cell.until("across")
    del cell.balls[next(iter(cell.balls))]
    cell.until("DONE")
    assert (cell.task.status.done, cell.task.status.total, cell.task.status.overlooked) == (2, 2, "")


def test_joined_motions_approach_without_contact_and_carry_with_attachment() -> None:
    cell = CellDouble(ONE)
    cell.until("DONE")
    approach, carry = cell.plans()
    assert (approach.stage, carry.stage) == ("pre-grasp", "across")
    for plan, via_z, blend, end_z in ((approach, 0.13, 0.05, 0.03), (carry, 0.18, 0.075, 0.225)):
        via, end = plan.goal.items
        assert (via.goal.pose.position.x, via.goal.pose.position.y) == ONE[0]
        assert (via.goal.pose.position.z, via.blend_radius) == pytest.approx((via_z, blend))
        assert end.goal.pose.position.z == pytest.approx(end_z)
    assert not approach.allowed_collisions and not approach.attach
    assert carry.attach == "track_0" and carry.attach_pose is not None


@pytest.mark.parametrize(("failing", "stages"), [
    (("pre-grasp", "across"), ["pre-grasp", "pre-grasp", "descend", "across", "lift", "across"]),
    (("across",), ["pre-grasp", "across", "lift", "across"]),
])
def test_stages_are_planned_separately_without_a_joined_plan(failing: tuple[str, ...], stages: list[str]) -> None:
    cell = CellDouble(ONE)
    cell.unplannable = lambda r: "no_path" if isinstance(r.goal, m.SequenceGoal) and r.stage in failing else ""
    cell.until("DONE")
    assert (cell.contained, cell.task.status.failures, cell.stages()) == (1, 0, stages)
    plans = {plan.stage: plan for plan in cell.plans()}
    assert not plans["pre-grasp"].allowed_collisions and not plans["pre-grasp"].attach
    assert "descend" not in plans or ("panda_hand", "track_0") in plans["descend"].allowed_collisions
    assert plans["lift"].attach == plans["across"].attach == "track_0" and plans["lift"].attach_pose is not None


def test_offered_yaw_ranges_of_a_round_object_are_clear() -> None:
    near = [(0.40 + 0.068, -0.30), (0.40 - 0.068, -0.30)]  # along x: the fingers close along y only
    cell = CellDouble([*ONE, *near])
    cell.unreachable = near
    cell.until("pre-grasp")
    grasps = cell.plans()[0].goal.items[-1].goal.goals
    yaws = [matrix_to_rpy(pose_to_matrix(goal.pose)[:3, :3])[2] for goal in grasps]
    assert sorted(abs(math.cos(yaw)) for yaw in yaws) == pytest.approx([1.0, 1.0])
    hand = cell.task.p.hand
    for goal, yaw in zip(grasps, yaws, strict=True):
        assert 0.05 < goal.yaw_tolerance < 0.8
        for turn in (-goal.yaw_tolerance, 0.0, goal.yaw_tolerance):
            assert finger_clearance(hand, ONE[0], yaw + turn, near, 0.03) >= hand.min_clearance


@pytest.mark.parametrize("fault", ["no image", "ball moved"])
def test_arm_stops_when_its_target_disappears(fault: str) -> None:
    cell = CellDouble(ONE)
    cell.until("pre-grasp")
    cell.step()
    if fault == "no image":
        cell.camera_on = False
    else:
        cell.balls["track_0"] = (0.52, -0.10, 0.03)
        assert any(isinstance(request, m.StopRequest) for request in cell.step())
    for _ in range(30):
        cell.step()
        cell.camera_on = not cell.task.status.message.startswith("pre-grasp: no fresh")
    cell.until("DONE")
    assert (cell.contained, cell.task.status.failures, cell.task.status.retries) == (1, 0, 0)


def test_gripper_above_the_ball_continues_without_a_view() -> None:
    cell = CellDouble(ONE)
    cell.until("pre-grasp")
    cell.tcp = (0.40, -0.30, 0.14)
    cell.camera_on = False
    cell.until("close")


def test_grasp_uses_expected_width_and_effort_of_the_scene() -> None:
    cell = CellDouble(ONE, width_tolerance=0.004)
    cell.until("DONE")
    close = next(r for r in cell.requests if isinstance(r, m.GripperCommand) and r.width == 0)
    assert (close.expected_width, close.width_tolerance, close.effort) == (0.06, 0.004, 0.0)
    bar = m.CollisionObject(id="bar", role="target", shape="box", dimensions=[0.05, 0.03, 0.02], grip_effort=2.0,
                            pose=matrix_to_pose(transform(rpy_to_matrix(0, 0, 0.3), (0.4, 0.0, 0.01))))
    sequences = MotionSequences(cell.task.p, cell.task.gripper)
    for yaw, width in ((0.3, 0.03), (0.3 - math.pi / 2, 0.05), (0.3 - math.pi, 0.03)):
        stages = sequences.pick_and_place(Pick(target=Target.of(bar), yaws=[yaw]))
        close = next(stage for stage in stages if stage.name == "close")
        assert (close.expected_width, close.effort) == (pytest.approx(width), 2.0)


@pytest.mark.parametrize(("kind", "message"), [
    ("slips", "the fingers closed on nothing"), ("outliers", "the fingers closed on a brick")])
def test_failed_grasp_is_released_and_retried_until_it_is_abandoned(kind: str, message: str) -> None:
    cell = CellDouble(ONE)
    setattr(cell, kind, 2)
    cell.until("open")
    assert cell.task.status.message == f"{message} at (0.400, -0.300)"
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries, cell.task.status.failures) == (1, 2, 0)
    retreats = [plan for plan in cell.plans() if plan.stage == "retreat"]
    assert len(retreats) >= 2
    for plan in retreats:
        assert plan.release and not plan.attach and ("panda_hand", "track_0") in plan.allowed_collisions
    cell = CellDouble(ONE, max_retries=2)
    setattr(cell, kind, 1000)
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries) == (0, 3)
    assert cell.task.status.skipped[0].reason == f"{message} 3 times"


def test_many_grasps_in_a_row_that_close_on_nothing_end_the_task_until_it_is_started_again() -> None:
    cell = CellDouble(SEVEN, max_failures=5)
    cell.slips = 5
    counted, messages = set(), list[str]()
    while cell.task.status.state != "ERROR":
        cell.unreachable = [SEVEN[4]] if cell.tcp[2] < 0.1 else []  # a low gripper hides the ball
        cell.step()
        counted.add(cell.task.status.total)
        messages.append(cell.task.status.message)
    assert counted == {7} and not [text for text in messages if "left" in text]
    assert messages[-1].startswith("the fingers closed on nothing at (")
    assert messages[-1].endswith("; that makes 5 grasps in a row")
    cell.unreachable = []
    cell.command("start")
    cell.until("DONE")
    assert cell.contained == 7


def test_wrong_object_found_in_the_gripper_is_released() -> None:
    cell = CellDouble(ONE)
    cell.outliers = 1
    cell.until("open")
    cell.command("stop")
    cell.steps(10)
    cell.gripper = cell.gripper.model_copy(update={"holding": True, "outcome": "too_wide"})
    cell.command("start")
    cell.until("retreat")
    assert not cell.gripper.holding
    cell.until("DONE")
    assert cell.contained == 1


def test_only_unreachable_balls_left_end_the_task_after_the_grace_period() -> None:
    cell = CellDouble([*ONE, (0.7, 0.4)])
    cell.unreachable = [(0.7, 0.4)]
    cell.until("release")
    released = cell.now
    cell.until("DONE")
    assert cell.contained == 1 and cell.now - released >= 8.0
    assert "1 object" in cell.task.status.message


def test_empty_table_ends_the_task_after_a_second_of_images() -> None:
    cell = CellDouble([])
    start = cell.now
    cell.until("DONE")
    assert 1.0 <= cell.now - start < 2.0
    cell = CellDouble([])
    cell.camera_on, cell._stamp = False, 0.0  # as a scene manager publishes before its first image
    cell.step()
    cell.camera_on = True
    start = cell.now
    cell.until("DONE")
    assert cell.now - start >= 1.0


@pytest.mark.parametrize(("balls", "parameters"), [(ONE, {}), ([], {"frame_timeout": 60.0})])
def test_missing_images_neither_end_the_task_nor_start_a_motion(balls, parameters) -> None:
    cell = CellDouble(balls, **parameters)
    cell.camera_on = False
    cell.now += 10
    cell.steps(300)
    assert cell.task.status.state == "IDLE"
    assert not any(isinstance(r, m.ExecuteRequest) for r in cell.requests)
    cell.camera_on = True
    cell.until("DONE")
    assert cell.contained == len(balls)


def test_empty_scene_does_not_end_the_task_while_there_are_targets() -> None:
    cell = CellDouble(ONE)
    known, cell.balls = cell.balls, {}
    for _ in range(50):
        cell.now += 0.1
        view = cell.view()
        # A restarted scene manager has to see it twice.
        view.seen.poses = [m.Pose(position=m.Vector3(x=0.40, y=-0.30, z=0.03))]
        assert cell.task.step(view) == []
        assert cell.task.status.state == "IDLE"
    cell.balls = known
    cell.until("DONE")
    assert cell.contained == 1


def test_unplannable_target_is_tried_at_every_yaw_then_skipped() -> None:
    cell = CellDouble([(0.40, -0.09), (0.40, 0.30)], joined=False)
    cell.unplannable = lambda r: "collision" if (
        r.stage == "descend" and len(cell.balls) > 1 and r.goal.pose.position.y < 0) else ""
    cell.until("DONE")
    assert cell.contained == 2
    assert cell.stages().count("descend") == cell.task.p.hand.yaw_count + 2


@pytest.mark.parametrize("plannable_from_home", [True, False])
def test_last_target_without_a_descent_is_retried_once_from_home(plannable_from_home: bool) -> None:
    cell = CellDouble([(0.40, -0.09)], joined=False)
    cell.unplannable = lambda r: "joint_jump" if r.stage == "descend" and not (
        plannable_from_home and "home" in cell.stages()) else ""
    cell.until("DONE")
    yaws, status = cell.task.p.hand.yaw_count, cell.task.status
    assert (cell.contained, status.failures) == (int(plannable_from_home), 0)
    assert [one.reason for one in status.skipped if "joint_jump" not in one.reason] == []
    assert bool(status.skipped) is not plannable_from_home
    assert (cell.stages().count("descend"), cell.stages().count("home")) == (
        yaws + 1 if plannable_from_home else 2 * yaws, 1)
    seeds = {plan.seed for plan in cell.plans() if plan.stage == "pre-grasp"}
    assert len(seeds) == 2  # else the same goals were drawn again


class Blocked(CellDouble):
    """The descent to the first ball is aborted until the other one is gone; `order` are the balls approached."""

    def arrive(self, request: m.ExecuteRequest) -> None:
        super().arrive(request)
        if self.task.status.stage == "pre-grasp":
            self.order.append(self.task.status.target)
            if self.task.status.target == "track_0" and len(self.balls) > 1:
                what = f"waypoint {len(self.order)} of 10 collides (fraction 0.{len(self.order)})"
                self.motion = self.motion.model_copy(update={"state": "aborted", "message": what})


def test_ball_whose_approach_failed_twice_for_one_reason_comes_after_the_others() -> None:
    cell = Blocked([(0.40, -0.20), (0.52, -0.30)], joined=False)
    cell.order = []
    cell.until("DONE")
    assert cell.order == ["track_0", "track_0", "track_1", "track_0"] and cell.contained == 2
    assert cell.task.status.failures == 2


def test_start_in_collision_causes_a_retreat_with_allowed_contact() -> None:
    cell = CellDouble(ONE)
    failing = ["start_in_collision"]
    cell.colliding = ("panda_hand", "track_0")
    cell.unplannable = lambda r: failing.pop() if failing and r.stage == "pre-grasp" else ""
    cell.until("DONE")
    retreat = next(plan for plan in cell.plans() if plan.stage == "retreat")
    assert ("panda_hand", "track_0") in retreat.allowed_collisions
    assert cell.contained == 1


@given(st.data())
def test_every_ball_ends_in_the_container_despite_faults(data: st.DataObject) -> None:
    cell = CellDouble(SEVEN)
    for _ in range(data.draw(st.integers(1, 6))):
        cell.steps(data.draw(st.integers(1, 60)))
        event = data.draw(st.sampled_from(["slip", "drop", "move", "restart", "abort", "forget"]))
        if event == "slip":
            cell.slips = 1
        elif event == "drop" and cell.held and cell.task.status.stage in ("lift", "across"):
            # The release happens above the container, where this arm jumps to only at the end.
            over = cell.task.deferred_grip == "release"
            if not over and all(abs(cell.tcp[0] - p[0]) + abs(cell.tcp[1] - p[1]) > 0.1 for p in cell.balls.values()):
                cell.drop()
        elif event == "move" and cell.balls:
            if all(abs(0.45 - p[0]) + abs(0.05 - p[1]) > 0.15 for p in cell.balls.values()):
                cell.balls[min(cell.balls)] = (0.45, 0.05, 0.03)
        elif event == "restart":
            cell.restart()
        elif event == "abort" and cell.motion.state == "active":
            cell.fail_motion()
        elif event == "forget" and cell.motion.state == "active":
            cell.running.clear()
            cell.motion = m.MotionStatus(header=m.Header(stamp=int((cell.now + 0.01) * 1e9)))
    cell.until("DONE", most=5000)
    assert (cell.contained, cell.balls, cell.held, cell.task.status.placed) == (7, {}, "", 7)


def test_arm_with_few_joints_gets_any_clear_yaw_and_tilt() -> None:
    cell = CellDouble(ONE)
    many = cell.task.p.robot
    few = many.model_copy(update={"joints": many.joints[:4]})
    ball, brick = Target("ball", (0.4, -0.3, 0.03), 0.03), Target("brick", (0.4, -0.3, 0.03), 0.03, (0.04, 0.03), 0.5)
    for robot, target, tilt, yaw in ((many, ball, 0.0, 0.0), (few, ball, 0.35, 0.4), (few, brick, 0.35, 0.0)):
        sequences = MotionSequences(
            cell.task.p.model_copy(update={"robot": robot, "joined": False}), cell.task.gripper)
        stages = sequences.pick_and_place(Pick(target=target, yaws=[0.5], ranges=[(-1.0, 0.2), (0.3, 0.4)]))
        goals = {stage.name: stage.goal for stage in stages if isinstance(stage, Move)}
        descend = goals["descend"]
        assert (descend.tilt_tolerance, descend.yaw_tolerance) == (tilt, yaw)
        middle = tool_down(0.4, -0.3, 0.03, 0.3 if yaw else 0.5)  # of the range in which the hand is clear
        assert pose_to_matrix(descend.pose) == pytest.approx(middle)
        assert goals["pre-grasp"].tilt_tolerance == max(tilt, cell.task.p.orient_tol_rad)
        assert goals["across"].tilt_tolerance == (0.9 if tilt else cell.task.p.orient_tol_rad)


@pytest.mark.parametrize("place", [(1e7, 0.0, 1e7), (0.4, -0.3, 1e7), (-1e7, 0.0, -1e7)])
def test_ball_out_of_message_range_is_no_target(place: tuple[float, float, float]) -> None:
    cell = CellDouble(ONE)
    cell.balls["far"] = place
    cell.until("DONE")
    assert cell.contained == 1
