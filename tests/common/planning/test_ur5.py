"""A second robot, with six joints and a base away from the origin, on its pillar next to the block with the objects."""

import numpy as np
import pytest

from common.config import Pipeline
from common.messages import Header, JointGoal
from common.planning.ik import solve_ik
from common.planning.pipeline import PlanningPipeline
from common.robot.transforms import tool_down
from tests.common.planning.checks import UR5_PIPELINE, assert_refused, is_free, last
from tests.common.planning.requests import to, to_joints, to_pose
from tests.common.planning.scenes import CELL, UR5, only, solid
from tests.common.planning.ur5_scene import HOME, SCENE, TOP, tip_at

WITH_POST = only(*SCENE.objects, solid("post", "target", "box", [0.14, 0.06, 0.16], (0.45, 0.0, 1.08)))
START = solve_ik(UR5, tool_down(0.45, -0.25, 1.12), HOME)
GOAL = solve_ik(UR5, tool_down(0.45, 0.25, 1.12), START)


@pytest.mark.parametrize("name", ["home", "default"])
def test_named_poses_are_free_next_to_the_block(name):
    world = UR5_PIPELINE.world(to(JointGoal(named="home"), HOME), SCENE, HOME)
    assert world.colliding_pair(UR5.named(name)) is None


def test_motion_above_the_block_along_a_line_and_home():
    there = to_pose(tip_at(0.5, 0.2, TOP + 0.15), HOME)
    move = UR5_PIPELINE.plan(there, SCENE)
    above = last(move)
    assert np.allclose(UR5.fk(above), tip_at(0.5, 0.2, TOP + 0.15), atol=1e-3)
    speeds = np.array([p.velocities for p in move.trajectory.points])
    accelerations = np.array([p.accelerations for p in move.trajectory.points])
    assert (np.abs(speeds) <= 0.2 * np.pi * 1.001).all() and (np.abs(accelerations) <= 0.2 * 5.0 * 1.001).all()

    across = to_pose(tip_at(0.5, -0.2, TOP + 0.01), above, straight=True)
    line = UR5_PIPELINE.plan(across, SCENE)
    assert is_free(UR5_PIPELINE, there, SCENE, move) and is_free(UR5_PIPELINE, across, SCENE, line)
    points = np.array([UR5.fk(p.positions)[:3, 3] for p in line.trajectory.points])
    first, span = points[0], points[-1] - points[0]
    off = np.cross(points - first, span / np.linalg.norm(span))
    assert np.linalg.norm(off, axis=1).max() < 1e-4 and np.abs(points[-1] - (0.5, -0.2, TOP + 0.01)).max() < 1e-4

    into = UR5_PIPELINE.plan(to_pose(tip_at(0.5, -0.2, TOP - 0.02), last(line), straight=True), SCENE)
    assert_refused(into, "collision", "robotiq_85")
    assert into.colliding[1] == "target_base"
    home = UR5_PIPELINE.plan(to(JointGoal(named="home"), last(line)), SCENE)
    assert np.allclose(last(home), HOME, atol=1e-6)


def test_scene_in_a_base_frame_away_from_world_is_refused():
    scene = SCENE.model_copy(update={"header": Header(frame_id="base_link")})
    response = UR5_PIPELINE.plan(to(JointGoal(named="home"), HOME), scene)
    assert_refused(response, "bad_scene", "base_link")


@pytest.mark.parametrize(("planner", "error"), [
    ("ompl", ""), ("chomp", ""), ("trajopt", ""), ("lerp", "collision"), ("ptp", "collision")])
def test_path_leads_around_a_post_or_is_refused_with_its_name(planner, error):
    pipeline = PlanningPipeline(UR5, CELL.motion, Pipeline.model_validate({"planners": [{"name": planner}]}))
    request = to_joints(GOAL.tolist(), START.tolist(), planning_time=60)
    response = pipeline.plan(request, WITH_POST)
    assert response.error == error, response.message
    if error:
        assert response.colliding[1] == "post"
    else:
        assert is_free(UR5_PIPELINE, request, WITH_POST, response)
        assert np.allclose(last(response), GOAL, atol=1e-6)
