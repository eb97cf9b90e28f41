"""A second robot, with six joints and a base away from the origin: the pipeline's motions and every planner."""

import numpy as np
import pytest

from common.config import Pipeline, load_cell
from common.messages import ArcGoal, Header, JointGoal, PlanningScene, PlanRequest, PlanResponse, PoseGoal, Vector3
from common.planning.ik import solve_ik
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planning_scenes import last
from tests.common.planning.planning_scenes import solid as object_of
from tests.common.planning.ur5_scene import HOME, PIPELINE, ROBOT, SCENE, TOP, tip_at, to_home, to_pose

CELL = load_cell("ur5")
POST = object_of("post", "target", "box", [0.14, 0.06, 0.16], (0.45, 0.0, 1.08))
WITH_POST = SCENE.model_copy(update={"objects": [*SCENE.objects, POST]})
LEFT = tool_down(0.45, 0.25, 1.12)
START = solve_ik(ROBOT, tool_down(0.45, -0.25, 1.12), HOME)
GOAL = solve_ik(ROBOT, LEFT, START)


def is_free(request: PlanRequest, response: PlanResponse, of: PlanningScene = SCENE) -> bool:
    world = PIPELINE.world(request, of, request.start)
    path, _ = fine_samples(timed_path(response.trajectory), 0.005)
    return not any(world.collides(q) for q in path)


@pytest.mark.parametrize("name", ["home", "default"])
def test_named_poses_are_free_next_to_the_block(name):
    world = PIPELINE.world(to_home(HOME), SCENE, HOME)
    assert world.colliding_pair(ROBOT.named(name)) is None


def test_motion_above_the_block_along_a_line_and_home():
    there = to_pose(tip_at(0.5, 0.2, TOP + 0.15), HOME)
    move = PIPELINE.plan(there, SCENE)
    above = last(move)
    assert np.allclose(ROBOT.fk(above), tip_at(0.5, 0.2, TOP + 0.15), atol=1e-3)
    speeds = np.array([p.velocities for p in move.trajectory.points])
    accelerations = np.array([p.accelerations for p in move.trajectory.points])
    assert (np.abs(speeds) <= 0.2 * np.pi * 1.001).all() and (np.abs(accelerations) <= 0.2 * 5.0 * 1.001).all()

    across = to_pose(tip_at(0.5, -0.2, TOP + 0.01), above, straight=True)
    line = PIPELINE.plan(across, SCENE)
    assert is_free(there, move) and is_free(across, line)
    points = np.array([ROBOT.fk(p.positions)[:3, 3] for p in line.trajectory.points])
    first, span = points[0], points[-1] - points[0]
    off = np.cross(points - first, span / np.linalg.norm(span))
    assert np.linalg.norm(off, axis=1).max() < 1e-4 and np.abs(points[-1] - (0.5, -0.2, TOP + 0.01)).max() < 1e-4

    assert np.allclose(last(PIPELINE.plan(to_home(last(line)), SCENE)), HOME, atol=1e-6)


def test_line_into_the_block_is_refused_with_the_pair():
    above = last(PIPELINE.plan(to_pose(tip_at(0.5, 0.0, TOP + 0.1), HOME), SCENE))
    response = PIPELINE.plan(to_pose(tip_at(0.5, 0.0, TOP - 0.02), above, straight=True), SCENE)
    assert response.error == "collision" and response.colliding is not None
    assert response.colliding[0].startswith("robotiq_85") and response.colliding[1] == "target_base"


def test_scene_in_a_base_frame_away_from_world_is_refused():
    scene = SCENE.model_copy(update={"header": Header(frame_id="base_link")})
    response = PIPELINE.plan(to_home(ROBOT.named("default")), scene)
    assert response.error == "bad_scene" and "base_link" in response.message


def planned(name: str, goal, of: PlanningScene = WITH_POST) -> PlanResponse:
    pipeline = PlanningPipeline(ROBOT, CELL.motion, Pipeline.model_validate({"planners": [{"name": name}]}))
    request = PlanRequest(id="1", start=START.tolist(), goal=goal, planning_time=60)
    response = pipeline.plan(request, of)
    if response.ok:
        assert is_free(request, response, of)
        assert np.allclose(ROBOT.fk(last(response)), LEFT, atol=2e-4)
    return response


@pytest.mark.parametrize("planner", ["ompl", "chomp", "trajopt"])
def test_path_around_a_post_is_found(planner):
    assert planned("lerp", JointGoal(positions=GOAL.tolist())).error == "collision"
    response = planned(planner, JointGoal(positions=GOAL.tolist()))
    assert response.ok, response.message


@pytest.mark.parametrize("planner", ["cartesian", "lin", "lerp", "ptp"])
def test_straight_path_through_a_post_is_refused_with_its_name(planner):
    goal = PoseGoal(pose=matrix_to_pose(LEFT))
    if planner in ("lerp", "ptp"):  # these might find another IK solution with a free edge
        goal = JointGoal(positions=GOAL.tolist())
    response = planned(planner, goal)
    assert response.error == "collision"
    assert response.colliding[1] == "post"
    assert planned(planner, goal, SCENE).ok


def test_arc_leads_over_the_post():
    response = planned("circ", ArcGoal(pose=matrix_to_pose(LEFT), via=Vector3(x=0.45, y=0.0, z=1.28)))
    assert response.ok, response.message
