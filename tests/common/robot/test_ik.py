import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.config import load_cell
from common.robot.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

robot = RobotModel.load(load_cell("panda").robot)
HOME = robot.named("home")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31))
def test_solution_puts_the_tcp_at_any_pose_that_was_reached(seed):
    rng = np.random.default_rng(seed)
    T = robot.fk(rng.uniform(robot.lower, robot.upper))
    q = solve_ik(robot, T, HOME, rng=rng, restarts=100)
    assert q is not None
    assert np.allclose(robot.fk(q), T, atol=2e-4)
    assert np.allclose(robot.fk(q)[:3, 3], T[:3, 3], atol=2e-5)
    assert robot.within_limits(q)


@pytest.mark.parametrize("yaw", [-1.0, 0.0, 1.0])
def test_grasps_all_over_the_table_are_found_from_home_alone(yaw):
    for x in (0.35, 0.5, 0.62):
        for y in (-0.3, 0.0, 0.3):
            assert solve_ik(robot, tool_down(x, y, 0.03, yaw), HOME, restarts=3) is not None


def test_pose_out_of_reach_has_no_solution():
    assert solve_ik(robot, tool_down(1.5, 0, 0.3), HOME, restarts=3) is None


def test_neighbouring_poses_have_neighbouring_solutions():
    q = HOME
    for x in np.linspace(robot.fk(HOME)[0, 3], 0.5, 20):
        following = solve_ik(robot, tool_down(x, 0, 0.48), q, restarts=0)
        assert following is not None
        assert np.abs(following - q).max() < 0.2
        q = following


def test_same_call_gives_the_same_solution():
    T = tool_down(0.4, -0.4, 0.05, 0.7)
    far = np.clip(-HOME, robot.lower, robot.upper)
    assert np.array_equal(solve_ik(robot, T, far), solve_ik(robot, T, far))
