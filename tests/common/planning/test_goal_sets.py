"""Alternative goals: a reachable one is found, the fastest one if the straight edges to them are free."""

import numpy as np
import pytest
from pydantic import ValidationError

from common.messages import GoalSet, JointGoal, PlanRequest, PoseGoal, Vector3
from common.planning import joint_goals
from common.planning.pipeline import PlanningPipeline
from common.planning.problem import Cancel
from common.planning.validation import Fault, validate
from tests.common.planning.checks import PIPELINE, assert_refused, last, seconds
from tests.common.planning.requests import LEFT, above, down, to
from tests.common.planning.scenes import CELL, HOME, ROBOT, TABLE, wall

SAMPLING = ["rrt_connect", "ompl", "ptp", "lerp", "chomp", "trajopt"]
LINES = ["cartesian", "lin"]


def to_any(goals: list[JointGoal | PoseGoal], start=HOME, **options) -> PlanRequest:
    return to(GoalSet(goals=goals), start, seed=1, **options)


NEAR, FAR = down(0.45, 0.05, 0.45), down(0.3, -0.5, 0.3)
BURIED, UNREACHABLE = down(0.5, 0.0, -0.1), down(1.2, 0.0, 0.6)


@pytest.mark.parametrize("planner", [*SAMPLING, ""])
def test_fastest_goal_is_chosen(planner):
    responses = [PIPELINE.plan(to_any(goals, planner=planner), TABLE) for goals in ([NEAR], [FAR], [FAR, NEAR])]
    near, far, both = map(seconds, responses)
    assert responses[2].goal_index == 1
    assert near < far and both == pytest.approx(near, rel=0.05)
    np.testing.assert_allclose(ROBOT.fk(last(responses[2]))[:3, 3], (0.45, 0.05, 0.45), atol=1e-3)


@pytest.mark.parametrize("planner", [*SAMPLING, *LINES, ""])
def test_unreachable_goals_are_skipped(planner):
    response = PIPELINE.plan(to_any([UNREACHABLE, BURIED, NEAR], planner=planner, straight=planner in LINES), TABLE)
    assert (response.ok, response.goal_index) == (True, 2), response.message


def test_colliding_joint_goals_are_skipped():
    below = above(0.5, 0.0, -0.05)
    assert PIPELINE.world(to_any([NEAR]), TABLE, HOME).collides(below)
    goals = [JointGoal(positions=below.tolist()), JointGoal(positions=LEFT.tolist()), BURIED]
    response = PIPELINE.plan(to_any(goals), TABLE)
    assert (response.ok, response.goal_index) == (True, 1), response.message


@pytest.mark.parametrize("planner", ["rrt_connect", "ompl", "lerp"])
def test_failure_of_each_goal_is_reported(planner):
    response = PIPELINE.plan(to_any([UNREACHABLE, BURIED], planner=planner), TABLE)
    why = "none of 2 goals; goal 1: no pose of the goal region can be reached: it is 1.23 m from the first joint"
    assert_refused(response, "goal_in_collision", f"{planner}: {why}")
    assert response.colliding is not None
    assert "; goal 2: all " in response.message and "collides with" in response.message


@pytest.mark.parametrize("planner", LINES)
def test_line_that_fails_validation_is_replaced_by_the_next(planner):
    lower, lowest = down(0.31, 0.0, 0.42), down(0.31, 0.0, 0.37)
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
    assert_refused(response, "collision", "none of 1 goals; goal 1: validation: found late")


def test_only_a_few_of_many_failures_are_reported():
    response = PIPELINE.plan(to_any([UNREACHABLE] * 30, planner="rrt_connect"), TABLE)
    assert response.error == "no_ik"
    assert response.message.endswith("; and 26 more") and len(response.message) < 500


@pytest.mark.parametrize("planner", ["rrt_connect", "ompl"])
def test_path_around_an_obstacle_leads_to_one_of_the_goals(planner):
    goals = [down(0.5, y, 0.2, yaw) for y in (-0.3, -0.25) for yaw in np.linspace(-1.5, 1.5, 10)]
    response = PIPELINE.plan(to_any(goals, LEFT, planner=planner), wall())
    end = ROBOT.fk(last(response))[:3, 3]
    reached = goals[response.goal_index].pose.position
    np.testing.assert_allclose(end, (reached.x, reached.y, reached.z), atol=1e-3)


@pytest.mark.parametrize(("goals", "error", "message"), [
    ([NEAR, down(40.0, 0, 0)], "out_of_reach", "goal 2 of 2: goal at (40, 0, 0) is 40 m away"),
    ([NEAR, NEAR, JointGoal(positions=[9.0] * 7)], "goal_out_of_limits", "goal 3 of 3: goal puts"),
    ([JointGoal(named="hoem"), NEAR], "unknown_pose", "goal 1 of 2: "),
])
def test_invalid_goal_is_refused_with_its_number(goals, error, message):
    assert_refused(PIPELINE.plan(to_any(goals), TABLE), error, message)


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
    assert_refused(response, "cancelled", "planning ended while 2 goals were sampled")


@pytest.mark.parametrize("planner", SAMPLING)
def test_pose_and_posture_in_a_region_are_chosen_for_least_time(planner, monkeypatch):
    goal = down(0.5, 0.1, 0.35, position_tolerance=Vector3(x=0.06, y=0.06, z=0.06), tilt_tolerance=0.25,
                yaw_tolerance=3.1)

    def total() -> float:
        starts = [HOME, above(0.4, -0.3, 0.3), above(0.6, -0.1, 0.4, 1.0)]
        return sum(seconds(PIPELINE.plan(to(goal, start, seed=1, planner=planner), TABLE)) for start in starts)

    chosen = total()
    monkeypatch.setattr(joint_goals, "fastest_goals_first", lambda problem, goals: sorted(
        goals, key=lambda q: float((np.abs(q - problem.start) / problem.velocity).max())))
    assert chosen < 0.9 * total()
