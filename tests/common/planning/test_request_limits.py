"""Limits of plan requests: a planner refuses extreme ones in little time."""

from time import process_time
from typing import Any

import numpy as np
import pytest

from common.messages import ArcGoal, PathGoal, PlanResponse, Pose, PoseGoal, SequenceGoal, SequenceItem, Vector3
from common.messages.robot import MAX_POINTS
from common.planning.path import dense_path
from common.planning.retiming import parametrise
from common.planning.trajectory import TimedPath, TooLong, require_sendable
from common.robot.transforms import matrix_to_pose
from tests.common.planning.checks import PIPELINE
from tests.common.planning.requests import to
from tests.common.planning.scenes import HOME, ROBOT, scene

HERE = matrix_to_pose(ROBOT.fk(HOME))
PLACE = HERE.position


def at(x: float, y: float = 0.0, z: float = 0.3) -> Pose:
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=HERE.orientation)


def behind(by: float) -> Pose:
    return at(PLACE.x - by, PLACE.y, PLACE.z)


def answer(goal: Any, **more: Any) -> PlanResponse:
    """Return the response, which took little CPU time whatever the planning time of the request."""
    began = process_time()
    response = PIPELINE.plan(to(goal, planning_time=60.0, **more), scene())
    assert process_time() - began < 4.0
    return response


@pytest.mark.parametrize("far", [1e5, 1e7, 100.0])
@pytest.mark.parametrize("straight", [False, True])
def test_extremely_distant_goal_is_refused_by_the_checks(far: float, straight: bool) -> None:
    refused = answer(PoseGoal(pose=at(far)), straight=straight)
    assert refused.error == "out_of_reach" and not refused.attempts
    assert f"goal at ({far:g}, 0, 0.3)" in refused.message and "which reaches 1." in refused.message


BEYOND = Vector3(x=PLACE.x - 1.0, y=PLACE.y + 2e-3, z=PLACE.z)  # almost on the line, behind the goal


@pytest.mark.parametrize(("goal", "error", "text"), [
    (PathGoal(waypoints=[HERE, at(1e5)]), "out_of_reach", ""),
    (ArcGoal(pose=at(1e5), via=Vector3(x=0.5)), "out_of_reach", ""),
    (ArcGoal(pose=at(0.5), via=Vector3(x=1e5)), "out_of_reach", ""),
    (SequenceGoal(items=[SequenceItem(goal=PoseGoal(pose=at(1e5)))]), "out_of_reach", ""),
    (PoseGoal(pose=at(ROBOT.reach + 0.1)), "no_ik", ""),
    (PathGoal(waypoints=[HERE, behind(0.1)], step=1e-7), "too_long", "1e+06 steps of the tool; the limit is 25000"),
    (PathGoal(waypoints=[HERE, behind(0.005)], step=5e-6), "retiming_failed", "finer than IK resolves joint positions"),
    (ArcGoal(pose=behind(0.2), via=BEYOND), "too_long", ""),
], ids=["path", "arc", "via", "sequence", "slightly out of reach", "steps", "fine steps", "radius"])
def test_goal_with_an_extreme_part_is_refused(goal: Any, error: str, text: str) -> None:
    refused = answer(goal, planner="circ" if isinstance(goal, ArcGoal) else "")
    assert refused.error == error and text in refused.message


def test_reach_is_an_upper_bound() -> None:
    random = np.random.default_rng(0)
    places = [ROBOT.fk(random.uniform(ROBOT.lower, ROBOT.upper))[:3, 3] for _ in range(500)]
    farthest = max(float(np.linalg.norm(place - ROBOT.foot)) for place in places)
    assert 0.5 * ROBOT.reach < farthest < ROBOT.reach


@pytest.mark.parametrize(("limit", "code", "text"), [
    ({"deadline": 0.0}, "timeout", "planning ended while the path was timed"),
    ({"step": 1e-6}, "too_long", f"a trajectory has {MAX_POINTS} at most"),
])
def test_timing_respects_deadline_and_number_of_states(limit: dict[str, float], code: str, text: str) -> None:
    path = dense_path(np.linspace(0, 1, 100)[:, None] * np.ones((1, 3)))
    with pytest.raises(TooLong, match=text) as refusal:
        parametrise(path, np.ones(3), np.ones(3), **limit)
    assert refusal.value.code == code


@pytest.mark.parametrize(("states", "duration"), [(MAX_POINTS + 1, 1.0), (10, 1e7)])
def test_trajectory_too_large_for_a_message_is_refused(states: int, duration: float) -> None:
    rest = np.zeros((states, 7))
    with pytest.raises(TooLong, match="states and takes"):
        require_sendable(TimedPath(np.linspace(0, duration, states), rest, rest, rest))
