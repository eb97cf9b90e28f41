import numpy as np
import pytest

from common.config import Motion, Pipeline
from common.messages import JointGoal, PlanRequest, Pose, Vector3
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import timed_path
from common.planning.validation import Fault, fine_samples
from common.robot.transforms import tool_down
from tests.common.planning.checks import PIPELINE, assert_refused, is_free, last, seconds
from tests.common.planning.requests import LEFT, RIGHT, above, to, to_joints, to_pose, touching
from tests.common.planning.scenes import BLOCK, CELL, EMPTY, HOME, ROBOT, TABLE, ball, held_scene, scene, wall, world

START = above(0.45, -0.25, 0.2)
NAMED_HOME = JointGoal(named="home")


def reached(request: PlanRequest, of) -> np.ndarray:
    """The end of a free motion."""
    response = PIPELINE.plan(request, of)
    assert is_free(PIPELINE, request, of, response)
    return last(response)


@pytest.mark.parametrize("yaw", [-np.pi / 4, np.pi / 4])
def test_ball_in_a_block_is_lifted_and_carried_into_the_box(yaw):
    x, y = BLOCK[0]
    block = scene(BLOCK)
    held = held_scene(block, "ball_0")
    grasp = reached(to_pose(tool_down(x, y, 0.03, yaw), above(x, y, 0.13, yaw), straight=True,
                            allowed_collisions=touching("ball_0")), block)
    assert np.linalg.norm(ROBOT.fk(grasp)[:3, 3] - (x, y, 0.03)) < 0.002
    for before in (block, held):  # planned ahead, and with the attached ball
        up = reached(to_pose(tool_down(x, y, 0.18, yaw), grasp, straight=True, attach="ball_0"), before)
    over = reached(to_pose(tool_down(0.55, 0.25, 0.25, yaw), up, tilt_tolerance=0.25, yaw_tolerance=3.14,
                           position_tolerance=Vector3(x=0.06, y=0.06, z=0.06)), held)
    assert np.linalg.norm(ROBOT.fk(over)[:2, 3] - (0.55, 0.25)) < 0.05


def test_grasp_that_hits_a_neighbour_is_refused_with_the_pair():
    x, y = BLOCK[0]
    response = PIPELINE.plan(to_pose(tool_down(x, y, 0.03), above(x, y, 0.13), straight=True, stage="grasp",
                                     allowed_collisions=touching("ball_0")), scene(BLOCK))
    assert_refused(response, "collision", "grasp: cartesian: waypoint")
    assert response.colliding[0] in ("panda_leftfinger", "panda_rightfinger")
    assert response.colliding[1] in ("ball_3", "ball_4")


def test_ball_to_be_grasped_is_an_obstacle_until_contact_is_allowed():
    x, y = BLOCK[0]
    nearby = to_pose(tool_down(x, y + 0.04, 0.03), above(x, y + 0.04, 0.13), straight=True)
    assert PIPELINE.plan(nearby, scene(BLOCK[:1])).colliding[1] == "ball_0"
    allowed = nearby.model_copy(update={"allowed_collisions": touching("ball_0")})
    assert PIPELINE.plan(allowed, scene(BLOCK[:1])).ok


def test_attached_ball_is_checked_against_obstacles():
    held = held_scene(scene(BLOCK[:1]), "ball_0")
    low = to_pose(tool_down(0.55, 0.25, 0.08), above(0.55, 0.02, 0.08), straight=True)
    response = PIPELINE.plan(low, held)
    assert (response.error, response.colliding) == ("collision", ("ball_0", "box_east"))
    assert PIPELINE.plan(low.model_copy(update={"release": True}), held).colliding != ("ball_0", "box_east")


def test_start_in_collision_is_refused_with_the_pair():
    stuck = above(0.35, -0.09, 0.03)
    response = PIPELINE.plan(to_pose(tool_down(0.35, -0.09, 0.2), stuck, stage="lift"), TABLE)
    message = "lift: request_checks: start is in collision: panda_rightfinger with ball_1"
    assert_refused(response, "start_in_collision", message)
    assert response.colliding == ("panda_rightfinger", "ball_1") and response.attempts == []


FAR = Pose(position=Vector3(z=1e7))


@pytest.mark.parametrize(("request_", "code", "text"), [
    (to_joints([0.0] * 6, START), "bad_goal", "6 positions for 7 joints"),
    (to_joints(HOME, [0.0] * 8), "bad_start", "8 positions for 7 joints"),
    (to_joints(HOME + 9 * np.eye(7)[6], START), "goal_out_of_limits", "panda_joint7"),
    (to_joints(HOME, HOME + 4 * np.eye(7)[3]), "start_out_of_limits", "panda_joint4"),
    (to_joints(above(0.68, 0.0, -0.02), START), "goal_in_collision", "table"),
    (to(JointGoal(named="hom"), START), "unknown_pose", "did you mean 'home'"),
    (to(JointGoal(), START), "bad_goal", "neither"),
    (PlanRequest(id="1", goal=NAMED_HOME), "no_state", "no joint state was received"),
    (to_joints(HOME, START, planner="chom"), "unknown_planner",
     "did you mean 'chomp'?); choices: cartesian, chomp, circ, joint_move, lerp"),
    (to_joints(HOME, START, planner="os.path"), "unknown_planner", "os.path"),
    (to_joints(HOME, START, attach="ball_99"), "unknown_object", "ball_99"),
    (to_joints(HOME, START, attach="ball_0", release=True), "bad_request", "contradict"),
    (to_joints(HOME, START, attach="ball_0", attach_pose=FAR), "bad_scene",
     "reaches 1e+07 m from a joint; the limit is 100 m"),
    (to_joints(HOME, START, straight=True), "no_planner", "straight line"),
    (to_pose(tool_down(0.5, 0, 0.3), START, straight=True, planner="lerp"), "no_planner", "straight line"),
    (to_joints(HOME, START, planner="cartesian"), "no_planner", "pose goal"),
    (to_pose(tool_down(0.4, 0, 0.3), START, position_tolerance=Vector3(x=-1)), "bad_goal", "negative"),
])
def test_bad_request_is_refused_with_code_and_choices_and_the_next_is_served(request_, code, text):
    assert_refused(PIPELINE.plan(request_, TABLE), code, text)
    assert PIPELINE.plan(to_joints(HOME, START), TABLE).ok


def test_current_state_is_the_default_start():
    response = PIPELINE.plan(PlanRequest(id="1", goal=NAMED_HOME), scene(), START)
    assert np.allclose(response.trajectory.points[0].positions, START, atol=1e-6)
    assert np.allclose(last(response), HOME, atol=1e-6)


def test_speed_scale_stretches_straight_lines_only():
    slow = PlanningPipeline(ROBOT, Motion(cartesian_speed_scale=0.5), CELL.pipeline)
    for request, ratio in ((to_pose(tool_down(0.45, 0.0, 0.2), START), 2), (to_joints(HOME, START), 1)):
        times = [seconds(pipeline.plan(request, scene())) for pipeline in (slow, PIPELINE)]
        assert times[0] / times[1] == pytest.approx(ratio)


def test_plan_uses_the_newest_scene():
    request = to_pose(tool_down(0.45, 0.15, 0.1), above(0.45, -0.15, 0.1), straight=True)
    for y, ok in ((0.0, False), (0.4, True), (0.0, False)):
        assert PIPELINE.plan(request, scene((), ball(0, 0.45, y, z=0.1), box=False)).ok is ok


def test_planner_is_found_by_its_dotted_module_or_by_name_outside_the_pipeline():
    entries = Pipeline.model_validate({"planners": [{"name": "common.planning.planners.joint_move"}]})
    pipeline = PlanningPipeline(ROBOT, CELL.motion, entries)
    assert pipeline.planners == ["joint_move"]
    assert pipeline.plan(to_joints(HOME, START), scene()).planner == "joint_move"
    for planner in ("lerp", "trajopt"):
        response = pipeline.plan(to_joints(HOME, START, planner=planner), EMPTY)
        assert response.ok and response.planner == planner, response.message
        assert {a.planner for a in response.attempts} == {planner}
        assert planner not in pipeline.planners, "it is not tried without a request"


def test_validation_applies_the_contact_rule_of_planning():
    x, y = BLOCK[0]
    close = scene([(x, y), (x + 0.0605, y)])
    start = above(x, y, 0.03, np.pi / 2 - 0.2)
    lifted = ROBOT.fk(start)
    lifted[2, 3] += 0.15
    rules = {"attach": "ball_0", "allowed_collisions": touching("ball_1"), "contact_distance": 0.05}
    request = to_pose(lifted, start, straight=True, **rules)
    response = PIPELINE.plan(request, close)
    strict = world(close, start, padding=0.003, attach="ball_0", allowed=touching("ball_1"), contact_distance=0.0)
    path, _ = fine_samples(timed_path(response.trajectory), 0.005)
    assert strict.first_collision(path) is not None and is_free(PIPELINE, request, close, response)


def test_colliding_blend_is_replaced_by_a_stop():
    def strict(trajectory, *_, **__):
        resting = np.abs(trajectory.velocities[1:-1]).max(axis=1) < 1e-9
        return None if resting.any() else Fault("collision", "waypoint 5 of 9: a collides with b", 5, ("a", "b"))

    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline, validator=strict)
    request = to_joints(LEFT, RIGHT, planner="ompl")
    assert is_free(pipeline, request, wall(), pipeline.plan(request, wall()))
    direct = pipeline.plan(to_joints(HOME, RIGHT, planner="ompl"), wall())
    assert_refused(direct, "collision", "ompl: validation: waypoint 5 of 9: a collides with b")
    assert [a.error for a in direct.attempts] == ["", "collision"]
