"""Tilt, region and speed of the tool along a path."""

from time import thread_time

import numpy as np
import pytest
from pydantic import ValidationError

from common.messages import Box, PlanRequest, Pose, PoseGoal, Vector3
from common.messages.planning import ArcGoal, GoalSet, PathConstraints, PathGoal, SequenceGoal, SequenceItem
from common.planning.constraints import PLANNING_SHARES, VALIDATION_SHARES, ToolConstraints, edge_cubic
from common.planning.joint_paths import line as steps_to
from common.planning.kernel.solvers import find_path
from common.planning.planners import lerp
from common.planning.problem import Result
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.transport.codec import decode, encode
from tests.common.planning.checks import (
    CANCELLED,
    PIPELINE,
    UR5_PIPELINE,
    assert_refused,
    is_free,
    planned,
    with_planner,
)
from tests.common.planning.constraint_checks import carries, constraints_of, driven, walled
from tests.common.planning.requests import LEFT, RIGHT, down, to, to_joints, to_pose
from tests.common.planning.scenes import EMPTY, HOME, ROBOT, UR5, wall, world

ARMS = {"panda": (ROBOT, PIPELINE), "ur5": (UR5, UR5_PIPELINE)}
OTHERS = ("joint_move", "lerp", "ptp", "ompl", "chomp", "trajopt", "lin")
TURN = np.eye(7)  # one joint in each row
LEANING = PoseGoal(pose=matrix_to_pose(transform(rpy_to_matrix(np.pi - 0.5, 0.0, 0.0), (0.5, 0.3, 0.3))))


def upright(tilt: float, **more) -> PathConstraints:
    return PathConstraints(tilt=tilt, **more)


def box(x, y, z, *sides) -> Box:
    return Box(pose=Pose(position=Vector3(x=x, y=y, z=z)), size=Vector3(x=sides[0], y=sides[1], z=sides[2]))


CORRIDOR = box(0.5, 0.0, 0.25, 0.2, 0.7, 0.2)


@pytest.mark.parametrize(("constraints", "text"), [
    ({"tilt": 0.0}, "0.005"),
    ({"tilt": float("nan")}, "finite"),
    ({"tilt": 4.0}, "3.14"),
    ({"tilt": 0.1, "axis": {"x": 0.0, "y": 0.0, "z": 0.0}}, "axis has length 0, and so no direction"),
    ({"tilt": 0.1, "tool_axis": {"x": 1e7, "y": 0.0, "z": 0.0}}, "no direction"),
    ({"region": {"pose": {}, "size": {"x": 1.0, "y": -1.0, "z": 1.0}}}, "a box has a side of -1 m"),
    ({"region": {"pose": {}}}, "size"),
    ({"tool_speed": 0.0}, "0.00001"),
    ({"tool_speed": "fast"}, "number"),
    ({"speed": 1.0}, "Extra"),
])
def test_message_refuses_invalid_constraint(constraints, text):
    with pytest.raises(ValidationError, match=text):
        PathConstraints.model_validate(constraints)


def test_wire_format_without_constraints_is_unchanged():
    plain = to_joints(LEFT, RIGHT)
    for name in ("constraints", "gripper_width"):
        assert name.encode() not in encode(plain) and name not in plain.model_dump_json()
    constrained = to_joints(LEFT, RIGHT, constraints=PathConstraints(tilt=0.1, region=CORRIDOR, tool_speed=0.2))
    for request in (plain, constrained):
        assert decode(PlanRequest, encode(request)) == request


@pytest.mark.parametrize(("goal", "start", "code", "text"), [
    (LEANING, RIGHT, "goal", "goal: the tool is tilted by 0.5 rad, 0.3 allowed"),
    (down(0.5, 0.2, 0.2), HOME + 0.5 * TURN[5], "start", "tilted by 0.5"),
    (down(0.5, 0.2, 0.5), RIGHT, "goal", "goal: the tool centre point is 150 mm outside its"),
    (LEANING.model_copy(update={"tilt_tolerance": 0.1}), RIGHT, "goal", "tilted by 0.5 rad, 0.3 allowed"),
    (ArcGoal(pose=LEANING.pose, via=Vector3(x=0.6, z=0.25)), RIGHT, "goal", "tilted by 0.5"),
    (PathGoal(waypoints=[matrix_to_pose(ROBOT.fk(RIGHT)), down(0.5, 0.0, 0.6).pose]), RIGHT, "goal",
     "point 2 of 2: the tool centre point is 250 mm outside"),
    (SequenceGoal(items=[SequenceItem(goal=down(0.5, 0.2, 0.2)), SequenceItem(goal=LEANING)]), RIGHT, "goal",
     "item 2 of 2: the tool is tilted by 0.5 rad"),
])
def test_violating_start_or_goal_is_refused_with_value_and_limit(goal, start, code, text):
    response = PIPELINE.plan(to(goal, start, constraints=upright(0.3, region=CORRIDOR)), EMPTY)
    assert_refused(response, f"{code}_violates_constraint", text)
    assert response.attempts == []


@pytest.mark.parametrize("planner", ["rrt_connect", *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_no_planner_returns_a_violating_trajectory(planner):
    satisfied = refused = 0
    pipeline = with_planner(planner)
    for tilt, size in ((0.5, 0.62), (0.25, 0.2), (0.03, 0.02)):
        region = box(0.5, 0.0, 0.2, size, 0.7, size)
        more = {"constraints": upright(tilt, region=region), "planning_time": 0.5}
        request = to_pose(ROBOT.fk(LEFT), RIGHT, **more) if planner == "lin" else to_joints(LEFT, RIGHT, **more)
        response = pipeline.plan(request, EMPTY)
        if response.ok:
            satisfied += 1
            way = driven(ROBOT, response)
            assert way.tilt() < tilt + 1e-3 and way.outside(region) < 1e-4
        else:
            refused += 1
            assert response.error in ("constraint", "timeout", "no_path"), response.message
    assert satisfied
    assert planner in ("lin", "rrt_connect") or refused


def test_violating_trajectory_of_a_planner_is_refused(monkeypatch):
    def careless(problem, options, cancel):
        return Result(waypoints=steps_to(problem.start, problem.goal, 40), dense=True, fraction=1.0)

    monkeypatch.setattr(lerp, "plan", careless)
    pipeline = with_planner("lerp")
    response = pipeline.plan(to_joints(LEFT, RIGHT, constraints=upright(0.03)), EMPTY)
    assert_refused(response, "constraint", "rad, 0.03 allowed")
    assert "waypoint" in response.message and response.attempts[0].waypoint
    assert pipeline.plan(to_joints(LEFT, RIGHT), EMPTY).ok


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("name", ARMS)
def test_proved_curve_satisfies_constraints_at_every_sample(name, compiled):
    robot, pipeline = ARMS[name]
    kernel = pipeline.world(to_joints(robot.named("home"), robot.named("home")), EMPTY, robot.named("home")).kernel
    rng = np.random.default_rng(len(name))
    satisfied = violated = 0
    for _ in range(15):
        q = rng.uniform(robot.lower, robot.upper)
        T = robot.fk(q)
        axis = T[:3, 2] + rng.normal(0, 0.02, 3)
        region = Box(pose=matrix_to_pose(T), size=Vector3(x=0.3, y=0.2, z=0.1))
        wanted = upright(float(rng.uniform(0.02, 0.5)), axis=Vector3(**dict(zip("xyz", axis.tolist(), strict=True))),
                         region=region)
        constraints = ToolConstraints(robot, wanted, q)
        if compiled:
            constraints.attach_to_kernel(kernel)
        cubic = np.stack([q, *rng.normal(0, rng.choice([0.01, 0.1, 0.3]), (3, robot.dof))])
        for pieces in (edge_cubic(q, cubic.sum(axis=0)), cubic[None]):
            curve = np.linspace(0, 1, 100)[:, None] ** np.arange(4) @ pieces[0]
            wrong = [constraints.state_violation(at, 1.0) for at in curve]
            for shares in (PLANNING_SHARES, VALIDATION_SHARES):
                found = constraints.first_violation(pieces, shares)
                if found is None:
                    satisfied += 1
                    assert not any(wrong)
                else:
                    violated += 1
                    assert constraints.state_violation(found[1] ** np.arange(4) @ pieces[0], 0.0)
    assert satisfied > 8 and violated > 8


def test_upright_may_be_defined_by_the_start():
    on_its_side = transform(rpy_to_matrix(np.pi / 2, 0.0, 0.0), (0.5, -0.1, 0.4))
    constraints = ToolConstraints(ROBOT, upright(0.1, upright_at_start=True), HOME)
    assert constraints.state_violation(HOME) == "" and constraints.pose_violation(on_its_side)
    leaning = ToolConstraints(ROBOT, upright(0.1, tool_axis=Vector3(y=-2.0), axis=Vector3(z=-5.0)), HOME)
    assert leaning.pose_violation(on_its_side) == "" and "tilted by 1.57" in leaning.state_violation(HOME)


def test_upright_goal_of_a_set_is_chosen_or_each_failure_is_reported():
    request = to(GoalSet(goals=[LEANING, down(0.5, 0.2, 0.25)]), RIGHT, constraints=upright(0.2))
    response = PIPELINE.plan(request, EMPTY)
    assert response.goal_index == 1 and driven(ROBOT, response).tilt() < 0.201
    request.goal = GoalSet(goals=[LEANING, down(2.0, 0.0, 0.2)])
    message = PIPELINE.plan(request, EMPTY).message
    assert "goal 1: " in message and "tilted by 0.5 rad, 0.2 allowed" in message
    assert "goal 2: no pose of the goal region can be reached: it is 2.0" in message


LINE = down(0.5, 0.3, 0.2)
TRACE = PathGoal(waypoints=[down(x, y, 0.2).pose for x, y in ((0.5, -0.3), (0.4, -0.1), (0.5, 0.1))])
CORNER = SequenceItem(goal=down(0.4, 0.0, 0.3), blend_radius=0.05, straight=True)
WEAVE = SequenceGoal(items=[CORNER, SequenceItem(goal=LINE)])


@pytest.mark.parametrize(("planner", "goal", "speed"), [
    ("joint_move", None, 0.05), ("joint_move", None, 0.4), ("rrt_connect", None, 0.05), ("ptp", None, 0.05),
    ("lerp", None, 0.05), ("cartesian", TRACE, 0.05), ("lin", LINE, 0.05), ("cartesian", LINE, 0.05),
    ("sequence", WEAVE, 0.05), ("sequence", WEAVE, 0.4),
])
def test_tool_speed_is_limited_and_used_fully(planner, goal, speed):
    request = to_joints(LEFT, RIGHT, constraints=PathConstraints(tool_speed=speed), planner=planner)
    if goal:
        request = request.model_copy(update={"goal": goal, "straight": planner in ("lin", "cartesian")})
    planned(PIPELINE, request, EMPTY)
    way = driven(ROBOT, PIPELINE.plan(request, EMPTY))
    assert way.speeds.max() < 1.01 * speed
    free = driven(ROBOT, PIPELINE.plan(request.model_copy(update={"constraints": None}), EMPTY))
    if free.speeds.max() > speed:
        assert way.speeds.max() > 0.9 * speed
    if planner in ("rrt_connect", "lerp", "lin") and speed < 0.1:  # slower only where it would be too fast
        length = np.linalg.norm(np.diff(way.places, axis=0), axis=1).sum()
        assert len(way.speeds) * 1e-3 < 1.1 * length / speed + 0.5


@pytest.mark.parametrize(("name", "what", "count"), [("panda", "tilt 0.1", 2), *(
    pytest.param(name, what, 20, marks=pytest.mark.campaign)
    for name in ("panda", "ur5") for what in ("tilt 0.3", "tilt 0.1", "tilt 0.1, corridor"))])
def test_glass_is_carried_upright_over_a_wall(name, what, count):
    robot, pipeline = ARMS[name]
    constraints, around = constraints_of(what, name), walled(name)
    for number, carry in enumerate(carries(robot, name, count, 0.5 * constraints.tilt)):
        request = to_pose(carry.T_world_goal, carry.start, constraints=constraints, planning_time=20.0, seed=number)
        response = pipeline.plan(request, around)
        way = driven(robot, response)
        assert way.tilt() < constraints.tilt + 1e-3
        assert constraints.region is None or way.outside(constraints.region) < 1e-4
        assert is_free(pipeline, request, around, response)


def test_impossible_constrained_search_ends_within_the_planning_time():
    over = wall(height=0.6)
    constraints = upright(0.3, region=CORRIDOR)
    request = to_joints(LEFT, RIGHT, constraints=constraints, planning_time=0.2, planner="rrt_connect")
    began = thread_time()  # not what a busy machine adds
    response = PIPELINE.plan(request, over)
    assert response.error in ("timeout", "no_path") and thread_time() - began < 0.5
    why = "found no path that satisfies the constraints; on the straight edge, panda_link5 collides with wall"
    assert response.message == f"rrt_connect: RRT-Connect {why}" and response.attempts[-1].message == why
    assert PIPELINE.plan(request, over, cancel=CANCELLED).error == "cancelled"


def test_constraints_apply_to_one_request_only():
    plain = to_joints(LEFT, RIGHT)
    before = PIPELINE.plan(plain, EMPTY)
    PIPELINE.plan(to_joints(LEFT, RIGHT, constraints=upright(0.03, region=CORRIDOR)), EMPTY)
    assert PIPELINE.plan(plain, EMPTY).trajectory == before.trajectory
    assert PIPELINE.world(plain, EMPTY, RIGHT).edge_free(HOME, HOME + TURN[5])


def test_fixed_tool_point_allows_only_a_turn_about_its_axis():
    held = upright(0.005, region=box(*ROBOT.fk(RIGHT)[:3, 3].tolist(), 0.001, 0.001, 0.001))
    fixed = world(EMPTY, RIGHT, constraints=ToolConstraints(ROBOT, held, RIGHT))
    assert fixed.edge_free(RIGHT, RIGHT + 0.5 * TURN[6])  # it turns about the tool axis
    found = find_path(fixed.kernel, RIGHT, np.array([LEFT]), seconds=0.05)
    assert found.waypoints is None and 1 <= found.from_start <= found.nodes - 1


def test_path_back_inside_the_limits_satisfies_constraints():
    inside = LEFT.copy()
    inside[0] = ROBOT.upper[0]
    out = inside + 0.03 * TURN[0]
    slow = to_joints(inside - 0.3 * TURN[0], out, constraints=PathConstraints(tool_speed=0.01))
    way = driven(ROBOT, PIPELINE.plan(slow, EMPTY))
    assert np.linalg.norm(way.places[0] - ROBOT.fk(out)[:3, 3]) < 1e-6 and 0.009 < way.speeds.max() < 0.0101
    middle = ROBOT.fk(inside - 0.15 * TURN[0])[:3, 3]
    side = 2 * float(np.abs(ROBOT.fk(inside)[:3, 3] - middle).max()) + 0.002
    region = box(*middle.tolist(), side, side, side)
    response = PIPELINE.plan(to_joints(inside, out, constraints=PathConstraints(region=region)), EMPTY)
    assert response.error == "start_violates_constraint"
