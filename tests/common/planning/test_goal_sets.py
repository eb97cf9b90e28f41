"""Alternative goals: a reachable one is found, the fastest one if the straight edges to them are free."""

import numpy as np
import pytest
from pydantic import ValidationError

from common.messages import GoalSet, JointGoal, PlanningScene, PlanRequest, PoseGoal, Vector3
from common.planning import joint_goals
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel
from common.planning.validation import Fault, validate
from common.robot.transforms import matrix_to_pose, tool_down
from tests.common.planning.planning_scenes import CELL, HOME, ROBOT, SPREAD, above, last, scene, solid

PIPELINE = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline)
TABLE = scene(SPREAD)
SAMPLING = ["rrt_connect", "ompl", "ptp", "lerp", "chomp", "trajopt"]
LINES = ["cartesian", "lin"]


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> PoseGoal:
    return PoseGoal(pose=matrix_to_pose(tool_down(x, y, z, yaw)))


def to_any(goals: list[JointGoal | PoseGoal], **options) -> PlanRequest:
    return PlanRequest(id="any", start=HOME.tolist(), goal=GoalSet(goals=goals), seed=1, **options)


NEAR, FAR = pose(0.45, 0.05, 0.45), pose(0.3, -0.5, 0.3)
BURIED, UNREACHABLE = pose(0.5, 0.0, -0.1), pose(1.2, 0.0, 0.6)


@pytest.mark.parametrize("planner", [*SAMPLING, ""])
def test_fastest_goal_is_chosen(planner):
    times = []
    for goals in ([NEAR], [FAR], [FAR, NEAR]):
        response = PIPELINE.plan(to_any(goals, planner=planner), TABLE)
        assert response.ok, response.message
        times.append(response.trajectory.points[-1].time_from_start)
    assert response.goal_index == 1
    assert times[0] < times[1] and times[2] == pytest.approx(times[0], rel=0.05)
    np.testing.assert_allclose(ROBOT.fk(last(response))[:3, 3], (0.45, 0.05, 0.45), atol=1e-3)


@pytest.mark.parametrize("planner", [*SAMPLING, *LINES, ""])
def test_unreachable_goals_are_skipped(planner):
    request = to_any([UNREACHABLE, BURIED, NEAR], planner=planner, straight=planner in LINES)
    response = PIPELINE.plan(request, TABLE)
    assert response.ok, response.message
    assert response.goal_index == 2


def test_colliding_joint_goals_are_skipped():
    below = above(0.5, 0.0, -0.05)
    assert PIPELINE.world(to_any([NEAR]), TABLE, HOME).collides(below)
    goals = [JointGoal(positions=below.tolist()), JointGoal(positions=above(0.5, 0.3, 0.2).tolist()), BURIED]
    response = PIPELINE.plan(to_any(goals), TABLE)
    assert response.ok, response.message
    assert response.goal_index == 1


@pytest.mark.parametrize("planner", ["rrt_connect", "ompl", "lerp"])
def test_failure_of_each_goal_is_reported(planner):
    response = PIPELINE.plan(to_any([UNREACHABLE, BURIED], planner=planner), TABLE)
    assert not response.ok and response.error == "goal_in_collision"
    assert response.colliding is not None
    why = "none of 2 goals; goal 1: no pose of the goal region can be reached: it is 1.23 m from the first joint"
    assert f"{planner}: {why}" in response.message
    assert "; goal 2: all " in response.message and "collides with" in response.message


def test_failure_of_each_line_is_reported():
    response = PIPELINE.plan(to_any([UNREACHABLE, BURIED], straight=True), TABLE)
    assert not response.ok
    assert "none of 2 goals; goal 1: waypoint" in response.message and "; goal 2: waypoint" in response.message


@pytest.mark.parametrize("planner", LINES)
def test_line_that_fails_validation_is_replaced_by_the_next(planner):
    lower, lowest = pose(0.31, 0.0, 0.42), pose(0.31, 0.0, 0.37)
    requests = [to_any(goals, straight=True, planner=planner) for goals in ([lowest, lower], [lower])]
    reached = last(PIPELINE.plan(requests[0], TABLE))
    assert ROBOT.fk(reached)[2, 3] == pytest.approx(0.42, abs=0.003)

    def not_to_the_nearest(trajectory, *arguments, **options):
        bad = np.allclose(trajectory.positions[-1], reached, atol=1e-6)
        return Fault("collision", "found late") if bad else validate(trajectory, *arguments, **options)

    pipeline = PlanningPipeline(ROBOT, CELL.motion, CELL.pipeline, validator=not_to_the_nearest)
    response = pipeline.plan(requests[0], TABLE)
    assert response.ok and response.goal_index == 0, response.message
    assert [attempt.error for attempt in response.attempts] == ["collision", ""]
    response = pipeline.plan(requests[1], TABLE)
    assert not response.ok and response.error == "collision"
    assert "none of 1 goals; goal 1: validation: found late" in response.message


def test_only_a_few_of_many_failures_are_reported():
    response = PIPELINE.plan(to_any([UNREACHABLE] * 30, planner="rrt_connect"), TABLE)
    assert response.error == "no_ik"
    assert response.message.endswith("; and 26 more") and len(response.message) < 500


def around(scene_: PlanningScene) -> PlanningScene:
    wall = solid("wall", "fixture", "box", [0.5, 0.02, 0.4], (0.55, 0.0, 0.2))
    return scene_.model_copy(update={"objects": [*scene(box=False).objects, wall]})


@pytest.mark.parametrize("planner", ["rrt_connect", "ompl"])
def test_path_around_an_obstacle_leads_to_one_of_the_goals(planner):
    goals = [pose(0.5, y, 0.2, yaw) for y in (-0.3, -0.25) for yaw in np.linspace(-1.5, 1.5, 10)]
    request = PlanRequest(id="any", start=above(0.5, 0.3, 0.2).tolist(), goal=GoalSet(goals=goals), planner=planner)
    response = PIPELINE.plan(request, around(TABLE))
    assert response.ok, response.message
    reached = goals[response.goal_index].pose.position
    np.testing.assert_allclose(ROBOT.fk(last(response))[:3, 3], (reached.x, reached.y, reached.z), atol=1e-3)


@pytest.mark.parametrize(("goals", "error", "message"), [
    ([NEAR, pose(40.0, 0, 0)], "out_of_reach", "goal 2 of 2: goal at (40, 0, 0) is 40 m away"),
    ([NEAR, NEAR, JointGoal(positions=[9.0] * 7)], "goal_out_of_limits", "goal 3 of 3: goal puts"),
    ([JointGoal(named="hoem"), NEAR], "unknown_pose", "goal 1 of 2: "),
])
def test_invalid_goal_is_refused_with_its_number(goals, error, message):
    response = PIPELINE.plan(to_any(goals), TABLE)
    assert (response.ok, response.error) == (False, error)
    assert message in response.message


@pytest.mark.parametrize("goals", [[], [NEAR] * 101, [{"kind": "sequence", "items": []}]])
def test_goal_set_has_one_to_a_hundred_single_goals(goals):
    with pytest.raises(ValidationError):
        GoalSet(goals=goals)


def test_goals_not_sampled_in_time_are_not_reported_as_unreachable(monkeypatch):
    flag, sample = Cancel(), joint_goals.sample_goals

    def once(*arguments, **options):
        found = sample(*arguments, **options)
        monkeypatch.setattr(joint_goals, "sample_goals", lambda *a, **o: flag.set() or sample(*a, **o))
        return found

    monkeypatch.setattr(joint_goals, "sample_goals", once)
    response = PIPELINE.plan(to_any([UNREACHABLE, NEAR], planner="rrt_connect"), TABLE, cancel=flag)
    assert (response.ok, response.error) == (False, "cancelled")
    assert "planning ended while 2 goals were sampled" in response.message


@pytest.mark.parametrize("planner", SAMPLING)
def test_pose_and_posture_in_a_region_are_chosen_for_least_time(planner, monkeypatch):
    goal = PoseGoal(pose=matrix_to_pose(tool_down(0.5, 0.1, 0.35)), position_tolerance=Vector3(x=0.06, y=0.06, z=0.06),
                    tilt_tolerance=0.25, yaw_tolerance=3.1)
    starts = [HOME, above(0.4, -0.3, 0.3), above(0.6, -0.1, 0.4, 1.0)]

    def seconds() -> float:
        total = 0.0
        for start in starts:
            request = PlanRequest(id="1", start=start.tolist(), goal=goal, seed=1, planner=planner)
            response = PIPELINE.plan(request, TABLE)
            assert response.ok, response.message
            total += response.trajectory.points[-1].time_from_start
        return total

    chosen = seconds()
    monkeypatch.setattr(joint_goals, "fastest_goals_first", lambda problem, goals: sorted(
        goals, key=lambda q: float((np.abs(q - problem.start) / problem.velocity).max())))
    assert chosen < 0.9 * seconds()
