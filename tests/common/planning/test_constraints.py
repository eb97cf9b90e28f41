import sys
from types import ModuleType

import numpy as np
import pytest
from pydantic import ValidationError

from common.config import Parameters, Pipeline
from common.messages import (
    ArcGoal,
    Box,
    GoalSet,
    PathConstraints,
    PathGoal,
    PlanRequest,
    Pose,
    PoseGoal,
    SequenceGoal,
    SequenceItem,
    Vector3,
)
from common.planning.collision import CollisionWorld
from common.planning.constraints import PLANNING_SHARES, VALIDATION_SHARES, ToolConstraints, edge_cubic
from common.planning.joint_paths import line as steps_to
from common.planning.kernel.solvers import find_path
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel, Result
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, tool_down, transform
from common.transport.codec import decode, encode
from tests.common.planning import ur5_scene
from tests.common.planning.constraint_checks import carries, constraints_of, driven, walled
from tests.common.planning.planner_checks import LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import CELL, HOME, ROBOT, scene, to_joints, to_pose

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
EMPTY = scene(box=False)
OTHERS = ("joint_move", "lerp", "ptp", "ompl", "chomp", "trajopt", "lin")
CORRIDOR = Box(pose=Pose(position=Vector3(x=0.5, z=0.25)), size=Vector3(x=0.2, y=0.7, z=0.2))
LEANING = transform(rpy_to_matrix(np.pi - 0.5, 0.0, 0.0), (0.5, 0.3, 0.3))


def upright(tilt: float, **more) -> PathConstraints:
    return PathConstraints(tilt=tilt, **more)


def pose_goal(T, **more) -> PoseGoal:
    return PoseGoal(pose=matrix_to_pose(T), **more)


@pytest.mark.parametrize(
    ("constraints", "text"),
    [
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
    ],
)
def test_invalid_constraint_is_refused_by_the_message(constraints, text):
    with pytest.raises(ValidationError, match=text):
        PathConstraints.model_validate(constraints)


def test_wire_format_without_constraints_is_unchanged():
    plain = to_joints(LEFT, RIGHT)
    for name in ("constraints", "gripper_width"):
        assert name.encode() not in encode(plain) and name not in plain.model_dump_json()
    constrained = to_joints(LEFT, RIGHT, constraints=PathConstraints(tilt=0.1, region=CORRIDOR, tool_speed=0.2))
    for request in (plain, constrained):
        assert decode(PlanRequest, encode(request)) == request


@pytest.mark.parametrize(
    ("goal", "start", "code", "text"),
    [
        (pose_goal(LEANING), RIGHT, "goal", "goal: the tool is tilted by 0.5 rad, 0.3 allowed"),
        (pose_goal(tool_down(0.5, 0.2, 0.2)), HOME + 0.5 * np.eye(7)[5], "start", "tilted by 0.5"),
        (pose_goal(tool_down(0.5, 0.2, 0.5)), RIGHT, "goal", "goal: the tool centre point is 150 mm outside its"),
        (pose_goal(LEANING, tilt_tolerance=0.1), RIGHT, "goal", "tilted by 0.5 rad, 0.3 allowed"),
        (ArcGoal(pose=matrix_to_pose(LEANING), via=Vector3(x=0.6, z=0.25)), RIGHT, "goal", "tilted by 0.5"),
        (PathGoal(waypoints=[matrix_to_pose(ROBOT.fk(RIGHT)), matrix_to_pose(tool_down(0.5, 0.0, 0.6))]), RIGHT, "goal",
         "point 2 of 2: the tool centre point is 250 mm outside"),
        (SequenceGoal(items=[SequenceItem(goal=pose_goal(tool_down(0.5, 0.2, 0.2))), SequenceItem(
            goal=pose_goal(LEANING))]), RIGHT, "goal", "item 2 of 2: the tool is tilted by 0.5 rad"),
    ],
)
def test_violating_start_or_goal_is_refused_with_value_and_limit(goal, start, code, text):
    request = PlanRequest(id="1", start=list(start), goal=goal, constraints=upright(0.3, region=CORRIDOR))
    response = PIPELINE.plan(request, EMPTY)
    assert response.error == f"{code}_violates_constraint"
    assert text in response.message
    assert "\n" not in response.message
    assert response.attempts == []


def test_goal_region_is_reached_with_an_upright_tool():
    goal = transform(rpy_to_matrix(np.pi - 0.35, 0.0, 0.0), (0.5, 0.3, 0.25))
    for planner in ("rrt_connect", "ompl", "ptp"):
        request = to_pose(goal, RIGHT, tilt_tolerance=0.3, constraints=upright(0.2), planner=planner)
        response = PIPELINE.plan(request, EMPTY)
        if response.ok:
            assert driven(ROBOT, response).tilt() < 0.201
        else:
            assert response.error in ("goal_violates_constraint", "constraint"), response.message
    assert PIPELINE.plan(request.model_copy(update={"planner": "rrt_connect"}), EMPTY).ok


@pytest.mark.parametrize("planner", ["rrt_connect", *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_no_planner_returns_a_violating_trajectory(planner):
    satisfied = refused = 0
    pipeline = with_planner(planner)
    for tilt, size in ((0.5, 0.62), (0.25, 0.2), (0.03, 0.02)):
        box = Box(pose=Pose(position=Vector3(x=0.5, z=0.2)), size=Vector3(x=size, y=0.7, z=size))
        constraints = upright(tilt, region=box)
        request = to_pose(ROBOT.fk(LEFT), RIGHT, constraints=constraints) if planner == "lin" else to_joints(
            LEFT, RIGHT, constraints=constraints)
        request.planning_time = 1.0
        response = pipeline.plan(request, EMPTY)
        if response.ok:
            satisfied += 1
            way = driven(ROBOT, response)
            assert way.tilt() < tilt + 1e-3
            assert way.outside(box) < 1e-4
        else:
            refused += 1
            assert response.error in ("constraint", "timeout", "no_path"), response.message
    assert satisfied
    assert planner in ("lin", "rrt_connect") or refused


def test_violating_trajectory_of_a_custom_planner_is_refused(monkeypatch):
    def plan(problem, options, cancel):
        return Result(waypoints=steps_to(problem.start, problem.goal, 40), dense=True, fraction=1.0)

    module = ModuleType("my_planners.careless")
    module.plan, module.Options = plan, type("Options", (Parameters,), {"__doc__": "None."})
    monkeypatch.setitem(sys.modules, "my_planners", ModuleType("my_planners"))
    monkeypatch.setitem(sys.modules, "my_planners.careless", module)
    pipeline = PlanningPipeline(ROBOT, CELL.motion, Pipeline.model_validate(
        {"planners": [{"name": "my_planners.careless"}, {"name": "rrt_connect"}]}))
    request = to_joints(LEFT, RIGHT, constraints=upright(0.03), planner="careless")
    response = pipeline.plan(request, EMPTY)
    assert response.error == "constraint"
    assert "waypoint" in response.message and "rad, 0.03 allowed" in response.message
    assert response.attempts[0].waypoint
    assert pipeline.plan(request.model_copy(update={"constraints": None}), EMPTY).planner == "careless"


def arms():
    return [(ROBOT, PIPELINE), (ur5_scene.ROBOT, ur5_scene.PIPELINE)]


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("number", [0, 1])
def test_proved_curve_satisfies_constraints_at_every_sample(number, compiled):
    robot, pipeline = arms()[number]
    kernel = pipeline.world(to_joints(robot.named("home"), robot.named("home")), EMPTY, robot.named("home")).kernel
    rng = np.random.default_rng(number)
    satisfied = violated = 0
    for _ in range(25):
        q = rng.uniform(robot.lower, robot.upper)
        T = robot.fk(q)
        wanted = PathConstraints(
            tilt=float(rng.uniform(0.02, 0.5)),
            axis=Vector3(**dict(zip("xyz", (T[:3, 2] + rng.normal(0, 0.02, 3)).tolist(), strict=True))),
            region=Box(pose=matrix_to_pose(transform(T[:3, :3], T[:3, 3])), size=Vector3(x=0.3, y=0.2, z=0.1)),
        )
        constraints = ToolConstraints(robot, wanted, q)
        if compiled:
            constraints.attach_to_kernel(kernel)
        cubic = np.stack([q, *rng.normal(0, rng.choice([0.01, 0.1, 0.3]), (3, robot.dof))])
        for pieces in (edge_cubic(q, cubic.sum(axis=0)), cubic[None]):
            c = pieces[0]
            wrong = [constraints.state_violation(np.array([1, t, t**2, t**3]) @ c, 1.0) for t in np.linspace(0, 1, 200)]
            for shares in (PLANNING_SHARES, VALIDATION_SHARES):
                found = constraints.first_violation(pieces, shares)
                if found is None:
                    satisfied += 1
                    assert not any(wrong)
                else:
                    violated += 1
                    t = found[1]
                    assert constraints.state_violation(np.array([1, t, t**2, t**3]) @ c, 0.0)
    assert satisfied > 15 and violated > 15


def test_upright_may_be_defined_by_the_start():
    on_its_side = transform(rpy_to_matrix(np.pi / 2, 0.0, 0.0), (0.5, -0.1, 0.4))
    constraints = ToolConstraints(ROBOT, upright(0.1, upright_at_start=True), HOME)
    assert constraints.state_violation(HOME) == ""
    assert constraints.pose_violation(on_its_side)
    leaning = ToolConstraints(ROBOT, upright(0.1, tool_axis=Vector3(y=-2.0), axis=Vector3(z=-5.0)), HOME)
    assert leaning.pose_violation(on_its_side) == ""
    assert "tilted by 1.57" in leaning.state_violation(HOME)


def test_upright_goal_of_a_set_is_chosen_or_each_failure_is_reported():
    leaning, good = pose_goal(LEANING), pose_goal(tool_down(0.5, 0.2, 0.25))
    request = PlanRequest(id="1", start=list(RIGHT), goal=GoalSet(goals=[leaning, good]), constraints=upright(0.2))
    response = PIPELINE.plan(request, EMPTY)
    assert response.goal_index == 1
    assert driven(ROBOT, response).tilt() < 0.201
    request.goal = GoalSet(goals=[leaning, pose_goal(tool_down(2.0, 0.0, 0.2))])
    response = PIPELINE.plan(request, EMPTY)
    assert "goal 1: " in response.message and "tilted by 0.5 rad, 0.2 allowed" in response.message
    assert "goal 2: no pose of the goal region can be reached: it is 2.0" in response.message


TRACE = PathGoal(waypoints=[matrix_to_pose(tool_down(x, y, 0.2)) for x, y in ((0.5, -0.3), (0.4, -0.1), (0.5, 0.1))])
WEAVE = SequenceGoal(items=[
    SequenceItem(goal=pose_goal(tool_down(0.4, 0.0, 0.3)), blend_radius=0.05, straight=True),
    SequenceItem(goal=pose_goal(tool_down(0.5, 0.3, 0.2))),
])


@pytest.mark.parametrize("speed", [0.4, 0.05])
@pytest.mark.parametrize(
    ("planner", "goal"),
    [("joint_move", None), ("rrt_connect", None), ("ptp", None), ("lerp", None), ("cartesian", TRACE),
     ("lin", pose_goal(tool_down(0.5, 0.3, 0.2))), ("cartesian", pose_goal(tool_down(0.5, 0.3, 0.2))),
     ("sequence", WEAVE)],
)
def test_tool_speed_is_limited_and_used_fully(planner, goal, speed):
    constraints = PathConstraints(tool_speed=speed)
    joints = to_joints(LEFT, RIGHT, constraints=constraints, planner=planner)
    request = joints.model_copy(update={"goal": goal, "straight": planner in ("lin", "cartesian")}) if goal else joints
    response = PIPELINE.plan(request, EMPTY)
    assert_sound(PIPELINE, request, EMPTY, response)
    way = driven(ROBOT, response)
    assert way.speeds.max() < 1.01 * speed
    free = driven(ROBOT, PIPELINE.plan(request.model_copy(update={"constraints": None}), EMPTY))
    if free.speeds.max() > speed:
        assert way.speeds.max() > 0.9 * speed
    if planner in ("rrt_connect", "lerp", "lin") and speed < 0.1:  # limit_tool_speed only where it is too fast
        length = np.linalg.norm(np.diff(way.places, axis=0), axis=1).sum()
        assert len(way.speeds) * 1e-3 < 1.1 * length / speed + 0.5


@pytest.mark.parametrize(("name", "what", "count"), [("panda", "tilt 0.1", 2), *(
    pytest.param(name, what, 20, marks=pytest.mark.campaign)
    for name in ("panda", "ur5") for what in ("tilt 0.3", "tilt 0.1", "tilt 0.1, corridor"))])
def test_glass_is_carried_upright_over_a_wall(name, what, count):
    robot, pipeline = arms()[name == "ur5"]
    constraints, around = constraints_of(what, name), walled(name)
    for number, carry in enumerate(carries(robot, name, count, 0.5 * constraints.tilt)):
        request = to_pose(carry.T_world_goal, carry.start, constraints=constraints, planning_time=20.0, seed=number)
        response = pipeline.plan(request, around)
        assert response.ok, (number, response.message)
        way = driven(robot, response)
        assert way.tilt() < constraints.tilt + 1e-3
        if constraints.region is not None:
            assert way.outside(constraints.region) < 1e-4
        world = pipeline.world(request, around, carry.start)
        path, _ = fine_samples(timed_path(response.trajectory), 0.02)
        assert not any(world.collides(q) for q in path)


def test_seed_decides_the_constrained_path():
    carry = carries(ROBOT, "panda", 1, 0.05)[0]
    request = to_pose(carry.T_world_goal, carry.start, constraints=upright(0.1), planner="rrt_connect", seed=3)
    one, other = (PIPELINE.plan(request, walled("panda")) for _ in range(2))
    assert one.trajectory == other.trajectory
    assert one.trajectory != PIPELINE.plan(request.model_copy(update={"seed": 4}), walled("panda")).trajectory


def test_impossible_constrained_search_ends_within_the_planning_time():
    over = wall(height=0.6, depth=0.5)
    constraints = upright(0.3, region=CORRIDOR)
    request = to_joints(LEFT, RIGHT, constraints=constraints, planning_time=0.3, planner="rrt_connect")
    response = PIPELINE.plan(request, over)
    assert response.error in ("timeout", "no_path")
    assert response.seconds < 0.6
    why = "found no path that satisfies the constraints; on the straight edge, panda_link5 collides with wall"
    assert response.message == f"rrt_connect: RRT-Connect {why}"
    assert response.attempts[-1].message == why
    cancel = Cancel()
    cancel.set()
    assert PIPELINE.plan(request, over, cancel=cancel).error == "cancelled"


def test_constraints_apply_to_one_request_only():
    request = to_joints(LEFT, RIGHT, constraints=upright(0.03, region=CORRIDOR))
    plain = request.model_copy(update={"constraints": None})
    before = PIPELINE.plan(plain, EMPTY)
    PIPELINE.plan(request, EMPTY)
    assert PIPELINE.plan(plain, EMPTY).trajectory == before.trajectory
    assert PIPELINE.world(plain, EMPTY, RIGHT).edge_free(HOME, HOME + 1.0 * np.eye(7)[5])


@pytest.mark.parametrize(
    ("place", "why"),
    [
        ((0.05, 0.0, 0.1), "panda_joint4 would be at -3.45, not in -3.07 to -0.07 rad"),
        ((0.9, 0.0, 0.1), "can be reached: the arm cannot reach it"),
        ((1.4, 0.0, 0.1), "it is 1.42 m from the first joint; the arm reaches 1."),
    ],
)
def test_unreachable_pose_is_reported_with_the_reason(place, why):
    for planner in ("ptp", "rrt_connect"):
        response = PIPELINE.plan(to_pose(tool_down(*place), RIGHT, planner=planner), EMPTY)
        assert response.error == "no_ik"
        assert why in response.message and why in response.attempts[-1].message


def test_fixed_tool_point_allows_only_a_turn_about_its_axis():
    start = ROBOT.fk(RIGHT)[:3, 3].tolist()
    held = PathConstraints(tilt=0.005, region=Box(
        pose=Pose(position=Vector3(**dict(zip("xyz", start, strict=True)))), size=Vector3(x=0.001, y=0.001, z=0.001)))
    goal = RIGHT + np.array([0, 0, 0, 0, 0, 0, 0.5])
    constraints = ToolConstraints(ROBOT, held, RIGHT)
    world = CollisionWorld(ROBOT, EMPTY, start=RIGHT, constraints=constraints)
    assert world.edge_free(RIGHT, goal)  # it turns about the tool axis
    found = find_path(world.kernel, RIGHT, np.array([LEFT]), seconds=0.1)
    assert found.waypoints is None
    assert 1 <= found.from_start <= found.nodes - 1


def test_path_back_inside_the_limits_satisfies_constraints():
    inside = LEFT.copy()
    inside[0] = ROBOT.upper[0]
    out = inside + 0.03 * np.eye(7)[0]
    goal = inside - 0.3 * np.eye(7)[0]
    slow = PIPELINE.plan(to_joints(goal, out, constraints=PathConstraints(tool_speed=0.01)), EMPTY)
    way = driven(ROBOT, slow)
    assert np.linalg.norm(way.places[0] - ROBOT.fk(out)[:3, 3]) < 1e-6
    assert 0.009 < way.speeds.max() < 0.0101
    x, y, z = ROBOT.fk(inside - 0.15 * np.eye(7)[0])[:3, 3].tolist()
    side = 2 * float(np.abs(ROBOT.fk(inside)[:3, 3] - (x, y, z)).max()) + 0.002
    box = Box(pose=Pose(position=Vector3(x=x, y=y, z=z)), size=Vector3(x=side, y=side, z=side))
    response = PIPELINE.plan(to_joints(inside, out, constraints=PathConstraints(region=box)), EMPTY)
    assert response.error == "start_violates_constraint"
