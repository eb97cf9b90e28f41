"""Limits of plan requests: a planner refuses extreme ones in little time."""

from time import process_time
from typing import Any

import numpy as np
import pytest

from common.messages import ArcGoal, PathGoal, Pose, PoseGoal, SequenceGoal, SequenceItem, Vector3
from common.messages.planning import PlanRequest, PlanResponse
from common.messages.robot import MAX_POINTS
from common.planning.path import dense_path
from common.planning.pipeline import PlanningPipeline
from common.planning.retiming import parametrise
from common.planning.trajectory import TimedPath, TooLong, require_sendable
from common.robot.transforms import matrix_to_pose
from tests.common.planning.planning_scenes import CELL, HOME, ROBOT, scene

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
HERE = matrix_to_pose(ROBOT.fk(HOME))


def at(x: float, y: float = 0.0, z: float = 0.3) -> Pose:
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=HERE.orientation)


def answer(goal: Any, **more: Any) -> PlanResponse:
    """Return the response, which took little CPU time whatever the planning time of the request."""
    began = process_time()
    request = PlanRequest(id="a", start=HOME.tolist(), goal=goal, planning_time=60.0, **more)
    response = PIPELINE.plan(request, scene())
    assert process_time() - began < 4.0
    return response


@pytest.mark.parametrize("far", [1e5, 1e7, 100.0])
@pytest.mark.parametrize("straight", [False, True])
def test_extremely_distant_goal_is_refused_by_the_checks(far: float, straight: bool) -> None:
    refused = answer(PoseGoal(pose=at(far)), straight=straight)
    assert refused.error == "out_of_reach" and not refused.attempts
    assert f"goal at ({far:g}, 0, 0.3)" in refused.message and "which reaches 1." in refused.message


@pytest.mark.parametrize("goal", [
    PathGoal(waypoints=[HERE, at(1e5)]), ArcGoal(pose=at(1e5), via=Vector3(x=0.5)),
    ArcGoal(pose=at(0.5), via=Vector3(x=1e5)), SequenceGoal(items=[SequenceItem(goal=PoseGoal(pose=at(1e5)))]),
], ids=["path", "arc", "via", "sequence"])
def test_extremely_distant_part_of_a_goal_is_refused(goal: Any) -> None:
    assert answer(goal).error == "out_of_reach"


def test_goal_slightly_out_of_reach_is_tried() -> None:
    assert answer(PoseGoal(pose=at(ROBOT.reach + 0.1))).error == "no_ik"


def test_reach_is_an_upper_bound() -> None:
    random = np.random.default_rng(0)
    places = [ROBOT.fk(random.uniform(ROBOT.lower, ROBOT.upper))[:3, 3] for _ in range(500)]
    farthest = max(float(np.linalg.norm(place - ROBOT.foot)) for place in places)
    assert 0.5 * ROBOT.reach < farthest < ROBOT.reach


def test_path_of_too_many_steps_is_refused_before_planning() -> None:
    place = HERE.position
    there = Pose(position=Vector3(x=place.x - 0.1, y=place.y, z=place.z), orientation=HERE.orientation)
    refused = answer(PathGoal(waypoints=[HERE, there], step=1e-7))
    assert refused.error == "too_long" and "1e+06 steps of the tool; the limit is 25000" in refused.message


def test_steps_finer_than_ik_resolves_are_refused() -> None:
    place = HERE.position
    there = Pose(position=Vector3(x=place.x - 0.005, y=place.y, z=place.z), orientation=HERE.orientation)
    refused = answer(PathGoal(waypoints=[HERE, there], step=5e-6))
    assert refused.error == "retiming_failed" and "finer than IK resolves joint positions" in refused.message


def test_arc_with_a_huge_radius_is_refused() -> None:
    place = HERE.position
    along = Vector3(x=place.x - 0.2, y=place.y, z=place.z)
    beyond = Vector3(x=place.x - 1.0, y=place.y + 2e-3, z=place.z)  # almost on the line, behind the goal
    refused = answer(ArcGoal(pose=Pose(position=along, orientation=HERE.orientation), via=beyond), planner="circ")
    assert refused.error == "too_long"


def test_timing_respects_deadline_and_number_of_states() -> None:
    path = dense_path(np.linspace(0, 1, 100)[:, None] * np.ones((1, 3)))
    with pytest.raises(TooLong, match="planning ended while the path was timed") as late:
        parametrise(path, np.ones(3), np.ones(3), deadline=0.0)
    assert late.value.code == "timeout"
    with pytest.raises(TooLong, match=f"a trajectory has {MAX_POINTS} at most") as long:
        parametrise(path, np.ones(3), np.ones(3), step=1e-6)
    assert long.value.code == "too_long"


@pytest.mark.parametrize(("states", "duration"), [(MAX_POINTS + 1, 1.0), (10, 1e7)])
def test_trajectory_too_large_for_a_message_is_refused(states: int, duration: float) -> None:
    rest = np.zeros((states, 7))
    with pytest.raises(TooLong, match="states and takes"):
        require_sendable(TimedPath(np.linspace(0, duration, states), rest, rest, rest))
