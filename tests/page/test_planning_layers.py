"""Ghosts of the robot for plans, and the tool path."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from common import messages as m
from common import topics
from tests.page.scene_cell import Stage, in_world

Array = NDArray[np.float64]


def plan(stage: Stage, q: Array, stamp: int = 0) -> m.JointTrajectory:
    """Return a straight motion of 2 s in joint space from home."""
    start, zeros = stage.robot.named("home"), [0.0] * len(q)
    return m.JointTrajectory(header=m.Header(stamp=stamp), joint_names=stage.robot.joint_names, points=[
        m.JointTrajectoryPoint(time_from_start=float(2.0 * s), positions=(start + s * (q - start)).tolist(),
                               velocities=zeros, accelerations=zeros) for s in np.linspace(0, 1, 40)])


@pytest.fixture
def home(panda: Stage) -> Array:
    q = panda.robot.named("home")
    panda.joints(q)
    return q


@pytest.fixture
def goal(home: Array) -> Array:
    return home + np.array([0.5, 0.2, 0, 0.1, 0, 0.1, 0])


def assert_ghost_at(stage: Stage, q: Array, tolerance: float = 1e-6, layer: str = "plan") -> None:
    hand = in_world(stage.server, stage.layer(layer).ghost.links["panda_hand"])
    np.testing.assert_allclose(hand, stage.robot.link_poses(q)["panda_hand"], atol=tolerance)


def test_ghost_is_at_the_end_of_the_plan_until_the_robot_arrives(panda: Stage, home: Array, goal: Array) -> None:
    ghost = panda.layer("plan").ghost
    assert not ghost.visible
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, goal))
    panda.joints(home)
    assert ghost.visible and ghost.links["panda_hand"].visible
    assert not ghost.links["panda_link0"].visible, "it coincides with the robot"
    assert_ghost_at(panda, goal)
    for q, visible in ((goal - 0.05, True), (goal, False)):
        panda.joints(q)
        assert ghost.visible is visible


def test_tool_path_is_a_line_until_a_plan_without_points(panda: Stage, goal: Array) -> None:
    trajectory = plan(panda, goal)
    panda.say(topics.DISPLAY_TRAJECTORY, trajectory)
    line = panda.layer("tool_path").line
    expected = [panda.robot.fk(point.positions)[:3, 3] for point in trajectory.points]
    np.testing.assert_allclose([line.points[0, 0], *line.points[:, 1]], expected, atol=1e-5)
    panda.say(topics.DISPLAY_TRAJECTORY, m.JointTrajectory(joint_names=panda.robot.joint_names, points=[]))
    assert not panda.layer("plan").ghost.visible and panda.layer("tool_path").line is None


def test_plan_of_unknown_joints_does_no_harm(panda: Stage, goal: Array) -> None:
    panda.view.play(plan(panda, goal).model_copy(update={"joint_names": [f"other_{i}" for i in range(7)]}))
    panda.joints(goal)
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, goal - 0.3, stamp=9))
    assert_ghost_at(panda, goal - 0.3)


def test_animation_repeats_the_plan_until_the_robot_moves(panda: Stage, home: Array, goal: Array) -> None:
    panda.view.play(plan(panda, goal))
    panda.joints(home)
    for seconds, share in ((1.0, 0.5), (1.5, 1.0), (1.0, 0.25)):  # it starts again after 2 s and a pause of 1 s
        panda.clock.now += seconds
        panda.joints(home)
        assert_ghost_at(panda, home + share * (goal - home), 1e-3)
    panda.clock.now += 0.5
    panda.joints(home + 0.04 * (goal - home))
    assert not panda.layer("plan").playing
    assert_ghost_at(panda, goal)


def test_animated_plan_is_not_restarted_when_the_planner_publishes_it(panda: Stage, goal: Array) -> None:
    panda.view.play(plan(panda, goal, stamp=5))
    for stamp, playing in ((5, True), (6, False)):
        panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, goal, stamp=stamp))
        assert panda.layer("plan").playing is playing


def test_two_plans_are_animated_concurrently_until_the_robot_moves(panda: Stage, home: Array, goal: Array) -> None:
    second = plan(panda, goal - 0.3, stamp=20)
    panda.view.compare(second)
    panda.view.play(plan(panda, goal, stamp=10))
    panda.say(topics.DISPLAY_TRAJECTORY, second, 0.0)  # the planner publishes its newest plan
    compared = panda.layer("compared")
    panda.joints(home)
    panda.clock.now += 1.999999
    panda.joints(home + 1e-5)
    assert_ghost_at(panda, goal, 1e-3)
    assert_ghost_at(panda, goal - 0.3, 1e-3, "compared")
    assert compared.line.points.shape[1:] == (2, 3) and panda.layer("tool_path").line is not None
    np.testing.assert_allclose(panda.layer("tool_path").line.points[-1][1], panda.robot.fk(goal)[:3, 3], atol=1e-4)
    panda.joints(home + 0.05)
    assert not compared.ghost.visible and compared.line is None


@pytest.mark.parametrize("ended", [
    {"interlocks": [m.Interlock(kind="stopped", by="page", since=9)]}, {"state": "aborted"}])
def test_plan_of_a_stopped_or_failed_motion_disappears(panda: Stage, goal: Array, ended: dict[str, Any]) -> None:
    ghost, path = panda.layer("plan").ghost, panda.layer("tool_path")
    panda.say(topics.MOTION_STATUS, m.MotionStatus(state="active"))
    panda.say(topics.DISPLAY_TRAJECTORY, plan(panda, goal, 1))
    assert ghost.visible and path.line is not None
    panda.say(topics.MOTION_STATUS, m.MotionStatus(**ended))
    assert not ghost.visible and path.line is None
    panda.view.play(plan(panda, goal, 2))  # of an operator
    assert ghost.visible and path.line is not None
