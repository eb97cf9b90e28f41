import numpy as np
import pytest

from common.config import Motion, Pipeline
from common.messages import Header, JointGoal, PlanRequest, Pose, Vector3
from common.planning.collision import CollisionWorld
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import timed_path
from common.planning.validation import Fault, fine_samples
from common.robot.transforms import tool_down
from tests.common.planning.planning_scenes import (
    BLOCK,
    CELL,
    HOME,
    ROBOT,
    SPREAD,
    above,
    ball,
    cache,
    held_scene,
    last,
    scene,
    solid,
    to_joints,
    to_pose,
    touching,
)

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
START = above(0.45, -0.25, 0.2)


def free_again(request, of, response) -> bool:
    """Whether the trajectory is free in a separate world, at a finer step, under the request's rules."""
    world = PIPELINE.world(request, of, request.start)
    path, _ = fine_samples(timed_path(response.trajectory), 0.005)
    return not any(world.collides(q) for q in path)


@pytest.mark.parametrize("yaw", [-np.pi / 4, np.pi / 4])
def test_ball_in_a_block_is_lifted_and_carried_into_the_box(yaw):
    x, y = BLOCK[0]
    block = scene(BLOCK)
    descend = to_pose(
        tool_down(x, y, 0.03, yaw), above(x, y, 0.13, yaw), straight=True, allowed_collisions=touching("ball_0")
    )
    down = PIPELINE.plan(descend, block)
    assert free_again(descend, block, down)
    assert np.linalg.norm(ROBOT.fk(last(down))[:3, 3] - (x, y, 0.03)) < 0.002

    held = held_scene(block, "ball_0")
    for before in (block, held):  # planned ahead, and with the attached ball
        lift = to_pose(tool_down(x, y, 0.18, yaw), last(down), straight=True, attach="ball_0")
        up = PIPELINE.plan(lift, before)
        assert free_again(lift, before, up)

    across = to_pose(
        tool_down(0.55, 0.25, 0.25, yaw), last(up), position_tolerance=Vector3(x=0.06, y=0.06, z=0.06),
        tilt_tolerance=0.25, yaw_tolerance=3.14,
    )
    over = PIPELINE.plan(across, held)
    assert free_again(across, held, over)
    assert np.linalg.norm(ROBOT.fk(last(over))[:2, 3] - (0.55, 0.25)) < 0.05


def test_grasp_that_hits_a_neighbour_is_refused_with_the_pair():
    x, y = BLOCK[0]
    request = to_pose(
        tool_down(x, y, 0.03, 0.0), above(x, y, 0.13, 0.0), straight=True, stage="grasp",
        allowed_collisions=touching("ball_0"),
    )
    response = PIPELINE.plan(request, scene(BLOCK))
    assert response.error == "collision"
    finger, other = response.colliding
    assert finger in ("panda_leftfinger", "panda_rightfinger")
    assert other in ("ball_3", "ball_4")
    assert response.message.startswith("grasp: cartesian: waypoint")


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
    assert response.error == "collision"
    assert response.colliding == ("ball_0", "box_east")
    assert PIPELINE.plan(low.model_copy(update={"release": True}), held).colliding != ("ball_0", "box_east")


def test_start_in_collision_is_refused_with_the_pair_and_the_next_request_is_served():
    stuck = above(0.35, -0.09, 0.03)
    response = PIPELINE.plan(to_pose(tool_down(0.35, -0.09, 0.2), stuck, stage="lift"), scene(SPREAD))
    assert response.error == "start_in_collision"
    assert response.colliding == ("panda_rightfinger", "ball_1")
    assert response.message == "lift: request_checks: start is in collision: panda_rightfinger with ball_1"
    assert response.attempts == []
    assert PIPELINE.plan(to_joints(HOME, START), scene(SPREAD)).ok


@pytest.mark.parametrize(
    ("request_", "code", "text"),
    [
        (to_joints([0.0] * 6, START), "bad_goal", "6 positions for 7 joints"),
        (to_joints(HOME, [0.0] * 8), "bad_start", "8 positions for 7 joints"),
        (to_joints(HOME + 9 * np.eye(7)[6], START), "goal_out_of_limits", "panda_joint7"),
        (to_joints(HOME, HOME + 4 * np.eye(7)[3]), "start_out_of_limits", "panda_joint4"),
        (to_joints(above(0.68, 0.0, -0.02), START), "goal_in_collision", "table"),
        (PlanRequest(id="1", start=list(START), goal=JointGoal(named="hom")), "unknown_pose", "did you mean 'home'"),
        (PlanRequest(id="1", start=list(START), goal=JointGoal()), "bad_goal", "neither"),
        (PlanRequest(id="1", goal=JointGoal(named="home")), "no_state", "no joint state was received"),
        (to_joints(HOME, START, planner="chom"), "unknown_planner",
         "did you mean 'chomp'?); choices: cartesian, chomp, circ, joint_move, lerp"),
        (to_joints(HOME, START, attach="ball_99"), "unknown_object", "ball_99"),
        (to_joints(HOME, START, attach="ball_0", release=True), "bad_request", "contradict"),
        (to_joints(HOME, START, straight=True), "no_planner", "straight line"),
        (to_joints(HOME, START, planner="cartesian"), "no_planner", "pose goal"),
        (to_pose(tool_down(0.4, 0, 0.3), START, position_tolerance=Vector3(x=-1)), "bad_goal", "negative"),
    ],
)
def test_bad_request_is_refused_with_code_and_choices_and_the_next_is_served(request_, code, text):
    response = PIPELINE.plan(request_, scene(SPREAD))
    assert not response.ok
    assert response.error == code
    assert text in response.message
    assert "\n" not in response.message
    assert response.trajectory is None
    assert PIPELINE.plan(to_joints(HOME, START), scene(SPREAD)).ok


def test_attached_object_far_beyond_the_arm_is_refused():
    with_ball = scene(SPREAD)
    ball = next(item.id for item in with_ball.objects if item.role == "target")
    far = {"attach": ball, "attach_pose": Pose(position=Vector3(z=1e7))}
    response = PIPELINE.plan(to_joints(HOME, START).model_copy(update=far), with_ball)
    assert response.error == "bad_scene" and "reaches 1e+07 m from a joint; the limit is 100 m" in response.message


def test_scene_in_another_frame_is_refused():
    elsewhere = scene().model_copy(update={"header": Header(frame_id="camera")})
    assert PIPELINE.plan(to_joints(HOME, START), elsewhere).error == "bad_scene"


def test_current_state_is_the_default_start():
    request = PlanRequest(id="1", goal=JointGoal(named="home"))
    response = PIPELINE.plan(request, scene(), START)
    assert np.allclose(response.trajectory.points[0].positions, START, atol=1e-6)
    assert np.allclose(last(response), HOME, atol=1e-6)


def test_scaling_of_the_request_changes_the_duration():
    def duration(scaling) -> float:
        request = to_joints(HOME, START, velocity_scaling=scaling, acceleration_scaling=scaling)
        response = PIPELINE.plan(request, scene())
        return response.trajectory.points[-1].time_from_start

    assert duration(0.1) > duration(None) > duration(0.8)


def test_speed_scale_stretches_straight_lines_only():
    slow = PlanningPipeline(ROBOT, Motion(cartesian_speed_scale=0.5), CELL.pipeline)
    for request, ratio in ((to_pose(tool_down(0.45, 0.0, 0.2), START), 2), (to_joints(HOME, START), 1)):
        times = [p.plan(request, scene()).trajectory.points[-1].time_from_start for p in (slow, PIPELINE)]
        assert times[0] / times[1] == pytest.approx(ratio)


def test_plan_uses_the_newest_scene():
    request = to_pose(tool_down(0.45, 0.15, 0.1), above(0.45, -0.15, 0.1), straight=True)
    for y, ok in ((0.0, False), (0.4, True), (0.0, False)):
        objects = [*scene(box=False).objects, ball(0, 0.45, y, z=0.1)]
        assert PIPELINE.plan(request, scene().model_copy(update={"objects": objects})).ok is ok


def test_planner_is_found_by_its_dotted_module():
    entries = Pipeline.model_validate({"planners": [{"name": "common.planning.planners.joint_move"}]})
    pipeline = PlanningPipeline(ROBOT, CELL.motion, entries)
    assert pipeline.planners == ["joint_move"]
    assert pipeline.plan(to_joints(HOME, START), scene()).planner == "joint_move"


def test_validation_applies_the_contact_rule_of_planning():
    x, y = BLOCK[0]
    close = scene([(x, y), (x + 0.0605, y)])
    start = above(x, y, 0.03, np.pi / 2 - 0.2)
    request = to_pose(
        ROBOT.fk(start) + np.array([[0] * 4, [0] * 4, [0, 0, 0, 0.15], [0] * 4]), start, straight=True,
        attach="ball_0", allowed_collisions=touching("ball_1"), contact_distance=0.05,
    )
    response = PIPELINE.plan(request, close)
    assert response.ok, response.message
    strict = CollisionWorld(
        ROBOT, close, start=start, padding=0.003, attach="ball_0", allowed=touching("ball_1"), contact_distance=0.0,
        cache=cache(),
    )
    path, _ = fine_samples(timed_path(response.trajectory), 0.005)
    assert strict.first_collision(path) is not None
    assert free_again(request, close, response)


def test_colliding_blend_is_replaced_by_a_stop():
    wall = [*scene(box=False).objects, solid("wall", "fixture", "box", [0.5, 0.02, 0.4], (0.55, 0.0, 0.2))]
    blocked = scene().model_copy(update={"objects": wall})
    left, right = above(0.5, 0.3, 0.2), above(0.5, -0.3, 0.2)

    def strict(trajectory, *_, **__):
        resting = np.abs(trajectory.velocities[1:-1]).max(axis=1) < 1e-9
        return None if resting.any() else Fault("collision", "waypoint 5 of 9: a collides with b", 5, ("a", "b"))

    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline, validator=strict)
    response = pipeline.plan(to_joints(left, right, planner="ompl"), blocked)
    assert response.ok
    assert free_again(to_joints(left, right), blocked, response)
    direct = pipeline.plan(to_joints(HOME, right, planner="ompl"), blocked)
    assert direct.error == "collision"
    assert direct.message == "ompl: validation: waypoint 5 of 9: a collides with b"
    assert [a.error for a in direct.attempts] == ["", "collision"]


@pytest.mark.parametrize("planner", ["lerp", "ptp", "trajopt"])
def test_planner_outside_the_pipeline_can_be_requested_by_name(planner):
    assert planner not in PIPELINE.planners
    request = to_joints(HOME, START, planner=planner)
    response = PIPELINE.plan(request, scene([]))
    assert response.ok and response.planner == planner, response.message
    assert free_again(request, scene([]), response)
    assert {a.planner for a in response.attempts} == {planner}
    assert planner not in PIPELINE.planners, "it is not tried without a request"


def test_request_cannot_import_arbitrary_modules():
    assert PIPELINE.plan(to_joints(HOME, START, planner="os.path"), scene([])).error == "unknown_planner"
