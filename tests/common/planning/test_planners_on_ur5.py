"""The same planners with a robot of six joints that stands on a base."""

import numpy as np
import pytest

from common.config import Pipeline, load_cell
from common.messages import ArcGoal, Header, JointGoal, PlanningScene, PlanRequest, PoseGoal, Vector3
from common.planning.ik import solve_ik
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planning_scenes import solid

CELL = load_cell("ur5")
ROBOT = RobotModel.load(CELL.robot)
OBJECTS = [
    solid("robot_base", "fixture", "cylinder", [0.175, 0.75], (0, 0, 0.375)),
    solid("target_base", "fixture", "box", [0.25, 0.75, 1.0], (0.5, 0, 0.5)),
    solid("post", "target", "box", [0.14, 0.06, 0.16], (0.45, 0.0, 1.08)),
]
SCENE = PlanningScene(header=Header(frame_id="world"), objects=OBJECTS)
LEFT, RIGHT = tool_down(0.45, 0.25, 1.12), tool_down(0.45, -0.25, 1.12)


def start() -> np.ndarray:
    q = solve_ik(ROBOT, RIGHT, ROBOT.named("home"))
    assert q is not None
    return q


START = start()
GOAL = solve_ik(ROBOT, LEFT, START)


def planned(name: str, goal, of=SCENE):
    entries = [{"name": name}]
    pipeline = PlanningPipeline(ROBOT, CELL.motion, Pipeline.model_validate({"planners": entries}))
    request = PlanRequest(id="1", start=START.tolist(), goal=goal, planning_time=60)
    response = pipeline.plan(request, of)
    if response.ok:
        path, _ = fine_samples(timed_path(response.trajectory), 0.005)
        world = pipeline.world(request, of, START)
        assert not any(world.collides(q) for q in path)
        assert np.allclose(ROBOT.fk(path[-1]), LEFT, atol=2e-4)
    return response


@pytest.mark.parametrize("planner", ["ompl", "chomp", "trajopt"])
def test_way_around_a_post_is_found(planner):
    assert planned("lerp", JointGoal(positions=GOAL.tolist())).error == "collision"
    response = planned(planner, JointGoal(positions=GOAL.tolist()))
    assert response.ok, response.message


@pytest.mark.parametrize("planner", ["cartesian", "lin", "lerp", "ptp"])
def test_straight_way_through_a_post_names_it(planner):
    goal = PoseGoal(pose=matrix_to_pose(LEFT))
    if planner in ("lerp", "ptp"):  # which might find another solution with a free way
        goal = JointGoal(positions=GOAL.tolist())
    response = planned(planner, goal)
    assert response.error == "collision"
    assert response.colliding[1] == "post"
    without = SCENE.model_copy(update={"objects": OBJECTS[:-1]})
    assert planned(planner, goal, without).ok


def test_arc_leads_over_the_post():
    response = planned("circ", ArcGoal(pose=matrix_to_pose(LEFT), via=Vector3(x=0.45, y=0.0, z=1.28)))
    assert response.ok, response.message
