from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from applications.pick_place.choice import Pick
from applications.pick_place.grasping import Target, finger_clearance
from applications.pick_place.motion_sequences import MotionSequences
from common import messages as m
from common.robot.transforms import matrix_to_pose, matrix_to_rpy, pose_to_matrix, rpy_to_matrix, tool_down, transform
from common.tasks.stages import Move
from tests.applications.pick_place.cell_double import SEVEN, CellDouble


def test_seven_balls_end_in_the_container() -> None:
    cell = CellDouble(SEVEN)
    cell.until("DONE")
    assert (cell.contained, cell.balls, cell.task.status.placed) == (7, {}, 7)
    assert cell.task.status.failures == 0


def test_nearest_ball_is_taken_first() -> None:
    cell = CellDouble([(0.6, -0.2), (0.35, 0.0)])
    cell.until("pre-grasp")
    assert cell.task.status.target == "track_1"


def test_next_pick_is_planned_while_the_ball_is_carried_across() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    cell.until("across")
    before = len(cell.stages())
    cell.step()
    assert cell.stages()[before:before + 1] == ["pre-grasp"]
    assert cell.motion.state == "active"


def test_motions_planned_ahead_start_at_the_end_of_the_previous_one() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30)])
    cell.until("DONE")
    plans = [r for r in cell.requests if isinstance(r, m.PlanRequest)]
    assert [bool(p.start) for p in plans[:4]] == [False, True, True, True]


def test_lost_ball_is_reported_at_the_end() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30), (0.40, -0.17)])
    cell.until("across")
    cell.drop()
    cell.balls = {name: place for name, place in cell.balls.items() if place[2] == 0.03 and place[1] != cell.tcp[1]}
    assert len(cell.balls) == 2  # it rolled out of the picture
    cell.until("DONE")
    status = cell.task.status
    assert (status.done, status.total) == (2, 3)
    assert status.overlooked == (
        "the table looks empty, but 1 that was seen before something fell out of the hand was not seen again")


def test_lost_ball_seen_only_while_rolling_is_reported_at_the_end() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30), (0.40, -0.17)])
    cell.until("across")
    cell.drop()
    fallen = next(reversed(cell.balls))
    x, y, z = cell.balls[fallen]
    for way in range(1, 13):
        cell.step()
        cell.balls[fallen] = (x - 0.03 * way, y, z)
    cell.step()
    del cell.balls[fallen]
    cell.until("DONE")
    status = cell.task.status
    assert (status.done, status.total) == (2, 3)
    assert status.overlooked == (
        "the table looks empty, but 1 that was seen before something fell out of the hand was not seen again")


def test_recovered_ball_is_not_reported_even_if_another_is_removed() -> None:
    cell = CellDouble([(0.40, -0.30), (0.52, -0.30), (0.40, -0.17)])
    cell.until("across")
    cell.drop()
    cell.until("close")
    cell.until("across")
    del cell.balls[next(iter(cell.balls))]
    cell.until("DONE")
    assert (cell.task.status.done, cell.task.status.total, cell.task.status.overlooked) == (2, 2, "")


def test_joined_motions_approach_without_contact_and_carry_with_attachment() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("DONE")
    plans = [r for r in cell.requests if isinstance(r, m.PlanRequest)]
    assert [r.stage for r in plans] == ["pre-grasp", "across"]
    for plan, low, high, then in ((plans[0], 0.13, 0.05, 0.03), (plans[1], 0.18, 0.075, 0.225)):
        assert isinstance(plan.goal, m.SequenceGoal)
        via, end = plan.goal.items
        assert isinstance(via.goal, m.PoseGoal) and isinstance(end.goal, m.PoseGoal)
        assert (via.goal.pose.position.x, via.goal.pose.position.y) == (0.40, -0.30)
        assert (via.goal.pose.position.z, via.blend_radius) == pytest.approx((low, high))
        assert end.goal.pose.position.z == pytest.approx(then)
    assert not plans[0].allowed_collisions and not plans[0].attach
    assert plans[1].attach == "track_0" and plans[1].attach_pose is not None


def test_stages_are_planned_separately_without_a_joined_plan() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.unplannable = lambda r: "no_path" if isinstance(r.goal, m.SequenceGoal) else ""
    cell.until("DONE")
    assert (cell.contained, cell.task.status.failures) == (1, 0)
    assert cell.stages() == ["pre-grasp", "pre-grasp", "descend", "across", "lift", "across"]
    cell = CellDouble([(0.40, -0.30)])
    cell.unplannable = lambda r: "no_path" if isinstance(r.goal, m.SequenceGoal) and r.stage == "across" else ""
    cell.until("DONE")
    assert cell.stages() == ["pre-grasp", "across", "lift", "across"]


def test_offered_yaw_ranges_of_a_round_object_are_clear() -> None:
    near = [(0.40 + 0.068, -0.30), (0.40 - 0.068, -0.30)]  # along x: the fingers close along y only
    cell = CellDouble([(0.40, -0.30), *near])
    cell.unreachable = near
    cell.until("pre-grasp")
    request = next(r for r in cell.requests if isinstance(r, m.PlanRequest))
    assert isinstance(request.goal, m.SequenceGoal)
    grasps = request.goal.items[-1].goal
    assert isinstance(grasps, m.GoalSet)
    yaws = [matrix_to_rpy(pose_to_matrix(goal.pose)[:3, :3])[2] for goal in grasps.goals]
    assert sorted(abs(math.cos(yaw)) for yaw in yaws) == pytest.approx([1.0, 1.0])
    for goal, yaw in zip(grasps.goals, yaws, strict=True):
        assert 0.05 < goal.yaw_tolerance < 0.8
        shape = cell.task.p.hand
        for turn in (-goal.yaw_tolerance, 0.0, goal.yaw_tolerance):
            assert finger_clearance(shape, (0.40, -0.30), yaw + turn, near, 0.03) >= shape.min_clearance


@pytest.mark.parametrize("blind", [False, True])
def test_arm_stops_when_its_target_disappears(blind: bool) -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    cell.step()
    if blind:
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
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    cell.tcp = (0.40, -0.30, 0.14)
    cell.camera_on = False
    cell.until("close")


def test_ball_is_an_obstacle_until_the_descent_then_may_be_touched_then_is_attached() -> None:
    cell = CellDouble([(0.40, -0.30)], joined=False)
    cell.until("DONE")
    plans = {r.stage: r for r in cell.requests if isinstance(r, m.PlanRequest)}
    assert not plans["pre-grasp"].allowed_collisions and not plans["pre-grasp"].attach
    assert ("panda_hand", "track_0") in plans["descend"].allowed_collisions and plans["descend"].straight
    assert plans["lift"].attach == "track_0" and plans["lift"].attach_pose is not None
    assert plans["across"].attach == "track_0"


def test_empty_grasp_is_retried_from_a_fresh_image() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.slips = 2
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries, cell.task.status.failures) == (1, 2, 0)
    assert cell.stages().count("retreat") == 2


def test_grasp_uses_expected_width_and_effort_of_the_scene() -> None:
    cell = CellDouble([(0.40, -0.30)], width_tolerance=0.004)
    cell.until("DONE")
    close = next(r for r in cell.requests if isinstance(r, m.GripperCommand) and r.width == 0)
    assert (close.expected_width, close.width_tolerance, close.effort) == (0.06, 0.004, 0.0)
    bar = m.CollisionObject(id="bar", role="target", shape="box", dimensions=[0.05, 0.03, 0.02], grip_effort=2.0,
                            pose=matrix_to_pose(transform(rpy_to_matrix(0, 0, 0.3), (0.4, 0.0, 0.01))))
    rows = MotionSequences(cell.task.p, cell.task.gripper)
    for yaw, width in ((0.3, 0.03), (0.3 - math.pi / 2, 0.05), (0.3 - math.pi, 0.03)):
        row = rows.pick_and_place(Pick(target=Target.of(bar), yaws=[yaw]))
        close = next(stage for stage in row if stage.name == "close")
        assert (close.expected_width, close.effort) == (pytest.approx(width), 2.0)


def test_grasp_of_unexpected_width_is_released_and_retried() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.outliers = 2
    cell.until("open")
    assert cell.task.status.message == "the fingers closed on a brick at (0.400, -0.300)"
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries, cell.task.status.failures) == (1, 2, 0)
    retreats = [r for r in cell.requests if isinstance(r, m.PlanRequest) and r.stage == "retreat"]
    assert retreats and not any(r.attach or not r.release for r in retreats)
    assert all(("panda_hand", "track_0") in r.allowed_collisions for r in retreats)


def test_object_of_wrong_width_is_abandoned() -> None:
    cell = CellDouble([(0.40, -0.30)], max_retries=2)
    cell.outliers = 1000
    cell.until("DONE")
    assert (cell.contained, cell.task.status.retries) == (0, 3)
    assert cell.task.status.skipped[0].reason == "the fingers closed on a brick 3 times"


def test_wrong_object_found_in_the_gripper_is_released() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.outliers = 1
    cell.until("open")
    cell.command("stop")
    for _ in range(10):
        cell.step()
    cell.gripper = cell.gripper.model_copy(update={"holding": True, "outcome": "too_wide"})
    cell.command("start")
    cell.until("retreat")
    assert not cell.gripper.holding
    cell.until("DONE")
    assert cell.contained == 1


def test_repeatedly_missed_position_is_abandoned_and_reported() -> None:
    cell = CellDouble([(0.40, -0.30)], max_retries=2)
    cell.slips = 1000
    cell.until("DONE")
    assert cell.task.status.retries == 3
    assert "closed on nothing 3 times" in cell.task.status.skipped[0].reason


@pytest.mark.parametrize("stage", ["lift", "across"])
def test_ball_lost_during_the_motion_is_picked_again(stage: str) -> None:
    cell = CellDouble([(0.40, -0.30), (0.40, 0.09)], joined=stage != "lift")
    cell.until(stage)
    cell.drop()
    asked = cell.step()
    assert any(isinstance(request, m.StopRequest) for request in asked)
    cell.until("DONE")
    assert (cell.contained, cell.task.status.failures) == (2, 1)


def test_only_unreachable_balls_left_end_the_task_after_the_grace_period() -> None:
    cell = CellDouble([(0.40, -0.30), (0.7, 0.4)])
    cell.unreachable = [(0.7, 0.4)]
    cell.until("release")
    released = cell.now
    cell.until("DONE")
    assert cell.contained == 1
    assert cell.now - released >= 8.0
    assert "1 object" in cell.task.status.message


def test_empty_table_ends_the_task_after_a_second() -> None:
    cell = CellDouble([])
    start = cell.now
    cell.until("DONE")
    assert 1.0 <= cell.now - start < 2.0


def test_missing_image_neither_ends_the_task_nor_starts_a_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.camera_on = False
    cell.now += 10
    for _ in range(300):
        cell.step()
    assert cell.task.status.state == "IDLE"
    assert not any(isinstance(r, m.ExecuteRequest) for r in cell.requests)
    cell.camera_on = True
    cell.until("DONE")
    assert cell.contained == 1


def test_missing_images_do_not_end_the_task() -> None:
    cell = CellDouble([], frame_timeout=30.0)
    cell.step()
    cell.camera_on = False
    for _ in range(100):
        cell.step()
    assert cell.task.status.state == "IDLE"
    cell.camera_on = True
    cell.until("DONE")


def test_first_image_after_an_outage_does_not_end_the_task() -> None:
    cell = CellDouble([])
    cell.camera_on, cell._stamp = False, 0.0  # as a scene manager that has seen nothing yet says
    cell.step()
    cell.camera_on = True
    start = cell.now
    cell.until("DONE")
    assert cell.now - start >= 1.0


def test_empty_scene_does_not_end_the_task_while_there_are_targets() -> None:
    cell = CellDouble([(0.40, -0.30)])
    known, cell.balls = cell.balls, {}
    for _ in range(50):
        cell.now += 0.1
        view = cell.view()
        pose = m.Pose(position=m.Vector3(x=0.40, y=-0.30, z=0.03))
        view.seen.poses = [pose]  # a scene manager that was started again has to see it twice
        assert cell.task.step(view) == []
        assert cell.task.status.state == "IDLE"
    cell.balls = known
    cell.until("DONE")
    assert cell.contained == 1


def test_unplannable_target_is_tried_at_every_yaw_then_skipped() -> None:
    cell = CellDouble([(0.40, -0.09), (0.40, 0.30)], joined=False)
    cell.unplannable = lambda r: "collision" if (
        r.stage == "descend" and len(cell.balls) > 1 and r.goal.pose.position.y < 0
    ) else ""
    cell.until("DONE")
    assert cell.contained == 2
    yaws = cell.task.p.hand.yaw_count
    assert cell.stages().count("descend") == yaws + 2


def test_last_target_without_a_descent_is_retried_from_home() -> None:
    cell = CellDouble([(0.40, -0.09)], joined=False)
    cell.unplannable = lambda r: "joint_jump" if r.stage == "descend" and "home" not in cell.stages() else ""
    cell.until("DONE")
    yaws = cell.task.p.hand.yaw_count
    assert cell.contained == 1 and not cell.task.status.skipped and not cell.task.status.failures
    assert (cell.stages().count("descend"), cell.stages().count("home")) == (yaws + 1, 1)
    seeds = {r.seed for r in cell.requests if isinstance(r, m.PlanRequest) and r.stage == "pre-grasp"}
    assert len(seeds) == 2  # else the same goals were drawn again


def test_unplannable_target_is_tried_twice() -> None:
    cell = CellDouble([(0.40, -0.09)])
    cell.unplannable = lambda r: "joint_jump" if r.stage == "descend" or isinstance(r.goal, m.SequenceGoal) else ""
    cell.until("DONE")
    assert cell.contained == 0 and "joint_jump" in cell.task.status.skipped[0].reason
    assert cell.stages().count("descend") == 2 * cell.task.p.hand.yaw_count
    assert cell.stages().count("home") == 1 and not cell.task.status.failures


def test_ball_that_moves_before_the_grasp_is_chosen_again() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    cell.balls["track_0"] = (0.52, -0.10, 0.03)
    cell.until("DONE")
    assert cell.contained == 1


def test_ball_added_near_the_path_invalidates_plans_made_ahead() -> None:
    cell = CellDouble([(0.40, -0.30)], joined=False)
    cell.until("pre-grasp")
    cell.balls["track_9"] = (0.50, -0.10, 0.03)
    before = len(cell.stages())
    cell.until("close")
    assert cell.stages()[before:][0] == "descend"
    cell.until("DONE")
    assert cell.contained == 2


def test_restart_while_holding_carries_the_ball_to_the_container() -> None:
    cell = CellDouble([(0.52, -0.04)], joined=False)
    cell.balls["track_5"] = (0.40, -0.30, 0.03)
    cell.until("lift")
    held = cell.held
    again = CellDouble([])
    again.balls, again.held, again.gripper, again.tcp = cell.balls, held, cell.gripper, (0.5, 0.0, 0.03)
    again.until("across")
    assert again.stages()[:2] == ["lift", "across"]
    again.until("DONE")
    assert (again.contained, again.held) == (2, "")


def test_restarted_task_waits_for_the_running_motion() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.motion = m.MotionStatus(id="other-1", state="active")
    for _ in range(20):
        assert cell.step() == []
    cell.motion = m.MotionStatus(id="other-1", state="succeeded")
    cell.until("DONE")
    assert cell.contained == 1


def test_home_only_after_a_failure() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    cell.motion = cell.motion.model_copy(update={"state": "aborted", "message": "path tolerance"})
    cell.running.clear()
    cell.until("HOMING")
    cell.until("DONE")
    assert (cell.contained, cell.task.status.failures, cell.stages().count("home")) == (1, 1, 1)


def test_failures_in_a_row_end_in_error_and_start_tries_again() -> None:
    cell = CellDouble([(0.40, -0.30)], max_failures=3)
    cell.until("pre-grasp")
    cell.unplannable = lambda r: "no_ik"
    cell.motion = cell.motion.model_copy(update={"state": "aborted", "message": "path tolerance"})
    cell.running.clear()
    cell.until("DONE")  # the ball is given up, which is no failure of the arm
    assert cell.task.status.failures >= 2
    assert cell.task.status.skipped


def test_motion_stopped_by_another_client_pauses_picking() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("pre-grasp")
    cell.motion = cell.motion.model_copy(update={"state": "cancelled", "message": "asked to"})
    cell.running.clear()
    cell.step()
    assert cell.task.status.paused
    assert cell.step() == []
    cell.task.command("resume", cell.view())
    cell.until("DONE")


def test_picking_waits_for_start() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.task.status.started = False
    for _ in range(50):
        assert cell.step() == []
    cell.task.command("start", cell.view())
    cell.until("DONE")


def test_ball_added_after_the_end_is_still_taken() -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.until("DONE")
    cell.balls["track_8"] = (0.52, -0.04, 0.03)
    cell.until("GRASPING")
    cell.until("DONE")
    assert cell.contained == 2


def test_start_in_collision_causes_a_retreat_with_allowed_contact() -> None:
    cell = CellDouble([(0.40, -0.30)])
    failing = ["start_in_collision"]

    def plan(request: m.PlanRequest) -> str:
        return failing.pop() if failing and request.stage == "pre-grasp" else ""

    cell.unplannable = plan
    original = cell.task.on_plan
    cell.task.on_plan = lambda response, view: original(  # type: ignore[method-assign]
        response.model_copy(update={"colliding": ("panda_hand", "track_0")}) if not response.ok else response, view)
    cell.until("DONE")
    retreat = next(r for r in cell.requests if isinstance(r, m.PlanRequest) and r.stage == "retreat")
    assert ("panda_hand", "track_0") in retreat.allowed_collisions
    assert cell.contained == 1


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_every_ball_ends_in_the_container_despite_faults(data: st.DataObject) -> None:
    cell = CellDouble(SEVEN)
    for _ in range(data.draw(st.integers(1, 6))):
        for _ in range(data.draw(st.integers(1, 60))):
            cell.step()
        event = data.draw(st.sampled_from(["slip", "drop", "move", "restart", "abort", "forget"]))
        if event == "slip":
            cell.slips = 1
        elif event == "drop" and cell.held and cell.task.status.stage in ("lift", "across"):
            # The release happens above the container, where this arm jumps to only at the end.
            over = cell.task.deferred_grip == "release"
            if not over and all(abs(cell.tcp[0] - p[0]) + abs(cell.tcp[1] - p[1]) > 0.1 for p in cell.balls.values()):
                cell.drop()
        elif event == "move" and cell.balls:
            name = sorted(cell.balls)[0]
            if all(abs(0.45 - p[0]) + abs(0.05 - p[1]) > 0.15 for p in cell.balls.values()):
                cell.balls[name] = (0.45, 0.05, 0.03)
        elif event == "restart":
            cell.restart()
        elif event == "abort" and cell.motion.state == "active":
            cell.running.clear()
            cell.motion = cell.motion.model_copy(update={"state": "aborted"})
        elif event == "forget" and cell.motion.state == "active":
            cell.running.clear()
            cell.motion = m.MotionStatus(header=m.Header(stamp=int((cell.now + 0.01) * 1e9)))
    cell.until("DONE", most=5000)
    assert (cell.contained, cell.balls, cell.held, cell.task.status.placed) == (7, {}, "", 7)


def test_arm_with_few_joints_gets_any_clear_yaw_and_tilt() -> None:
    cell = CellDouble([(0.40, -0.30)])
    few = cell.task.p.robot.model_copy(update={"joints": cell.task.p.robot.joints[:4]})
    ball, brick = Target("ball", (0.4, -0.3, 0.03), 0.03), Target("brick", (0.4, -0.3, 0.03), 0.03, (0.04, 0.03), 0.5)
    many = cell.task.p.robot
    for robot, thing, tilt, yaw in ((many, ball, 0.0, 0.0), (few, ball, 0.35, 0.4), (few, brick, 0.35, 0.0)):
        rows = MotionSequences(cell.task.p.model_copy(update={"robot": robot, "joined": False}), cell.task.gripper)
        row = rows.pick_and_place(Pick(target=thing, yaws=[0.5], ranges=[(-1.0, 0.2), (0.3, 0.4)]))
        goals = {stage.name: stage.goal for stage in row if isinstance(stage, Move)}
        descend, over = goals["descend"], goals["pre-grasp"]
        assert isinstance(goals["across"], m.PoseGoal)
        assert isinstance(descend, m.PoseGoal) and isinstance(over, m.PoseGoal)
        assert (descend.tilt_tolerance, descend.yaw_tolerance) == (tilt, yaw)
        middle = tool_down(0.4, -0.3, 0.03, 0.3 if yaw else 0.5)  # of the range in which the hand is clear
        assert pose_to_matrix(descend.pose) == pytest.approx(middle)
        assert over.tilt_tolerance == max(tilt, cell.task.p.orient_tol_rad)
        assert goals["across"].tilt_tolerance == (0.9 if tilt else cell.task.p.orient_tol_rad)


@pytest.mark.parametrize("place", [(1e7, 0.0, 1e7), (0.4, -0.3, 1e7), (-1e7, 0.0, -1e7)])
def test_ball_out_of_message_range_is_no_target(
    place: tuple[float, float, float]
) -> None:
    cell = CellDouble([(0.40, -0.30)])
    cell.balls["far"] = place
    cell.until("DONE")
    assert cell.contained == 1
