"""A robot outside a joint limit, for example pushed by hand: plans lead inside, and no motion leads farther outside."""

import numpy as np
import pytest

from common.control.limiter import Limiter
from common.control.trajectory import Tolerances, checked_trajectory
from common.errors import Refused
from common.hardware.interface import Limits
from common.planning.planners import planner_names
from common.planning.trajectory import timed_path
from common.planning.validation import validate
from common.robot.transforms import tool_down
from tests.common.planning.checks import PIPELINE
from tests.common.planning.requests import above, to_joints, to_pose
from tests.common.planning.scenes import HOME, ROBOT, TABLE

ELBOW, SHOULDER, LAST = 3, 1, 6
STILL = np.zeros(ROBOT.dof)
LIMITS = Limits(ROBOT.joint_names, ROBOT.lower, ROBOT.upper, ROBOT.velocity, ROBOT.acceleration, ROBOT.acceleration,
                ROBOT.jerk)


def outside(by: float) -> np.ndarray:
    """The elbow stretched and the shoulder leant back beyond their limits."""
    q = HOME.copy()
    q[ELBOW], q[SHOULDER] = ROBOT.upper[ELBOW] + by, ROBOT.lower[SHOULDER] - by
    return q


def excess(q: np.ndarray) -> np.ndarray:
    return np.maximum(np.maximum(ROBOT.lower - q, q - ROBOT.upper), 0)


@pytest.mark.parametrize("planner", [name for name in planner_names() if name not in ("circ", "sequence", "tracking")])
@pytest.mark.parametrize("by", [0.0005, 0.04])
def test_plan_of_any_planner_leads_inwards_first(planner, by):
    lines = planner in ("cartesian", "lin")
    start = np.array([*HOME[:-1], ROBOT.upper[-1] + by]) if lines else outside(by)
    goal = ROBOT.fk(np.clip(start, ROBOT.lower, ROBOT.upper))
    goal[2, 3] -= 0.05
    request = to_pose(goal, start, planner=planner) if lines else to_joints(HOME, start, planner=planner)
    response = PIPELINE.plan(request, TABLE)
    assert response.ok, response.message
    trajectory = timed_path(response.trajectory)
    np.testing.assert_array_equal(trajectory.positions[0], start)
    out = excess(trajectory.positions)
    assert (np.diff(out, axis=0) <= 0).all() and not out[-1].any()
    accepted = checked_trajectory(response.trajectory, LIMITS, start + 1e-4, Tolerances())
    limiter, t, q = Limiter(LIMITS, start, 0.01), 0.0, [start]
    while t < trajectory.duration:
        t += 0.01
        q.append(limiter.step(*accepted.at(t), 0.01)[0])
    assert (np.diff(excess(np.array(q)), axis=0) <= 1e-9).all()
    assert np.abs(q[-1] - trajectory.positions[-1]).max() < 1e-3


@pytest.mark.parametrize(("goal", "start", "code"), [
    (HOME, outside(0.06), "start_out_of_limits"), (outside(0.001), HOME, "goal_out_of_limits")])
def test_start_beyond_the_tolerance_or_goal_outside_the_limits_is_refused(goal, start, code):
    response = PIPELINE.plan(to_joints(goal, start), TABLE)
    assert (response.ok, response.error) == (False, code)


def test_obstacle_on_the_path_back_inside_is_named():
    free, low = above(0.5, 0.0, 0.15), above(0.5, 0.0, -0.05)
    free[LAST] = low[LAST] = ROBOT.upper[LAST] + 0.04
    up = tool_down(0.5, 0, 0.3, 0.0)
    assert PIPELINE.plan(to_pose(up, free), TABLE).error != "start_in_collision"
    response = PIPELINE.plan(to_pose(up, low), TABLE)
    assert response.error == "start_in_collision" and response.colliding


def test_trajectory_that_leads_outside_is_refused():
    response = PIPELINE.plan(to_joints(HOME, outside(0.03)), TABLE)
    message = response.trajectory.model_copy(deep=True)
    message.points.reverse()
    for point, other in zip(message.points, response.trajectory.points, strict=True):
        point.time_from_start = other.time_from_start
        point.velocities = [-v for v in point.velocities]
    with pytest.raises(Refused, match="exceeds the limit of panda_joint"):
        checked_trajectory(message, LIMITS, HOME, Tolerances())
    world = PIPELINE.world(to_joints(HOME, HOME), TABLE, HOME)
    limits = {"velocity": ROBOT.velocity, "acceleration": ROBOT.acceleration}
    fault = validate(timed_path(message), ROBOT, world, start=HOME, step=0.01, **limits)
    assert fault is not None and fault.code == "position_limit"
