import numpy as np
import pytest

from common.errors import ConfigError
from common.planning.joint_paths import line
from common.planning.planners import lerp
from common.robot.transforms import tool_down
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import above, last, to_joints, to_pose


def test_way_is_a_straight_line_in_joint_space():
    pipeline = with_planner("lerp")
    request = to_joints(LEFT, RIGHT)
    trajectory = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    span = LEFT - RIGHT
    share = (trajectory.positions - RIGHT) @ span / (span @ span)
    assert np.allclose(trajectory.positions, RIGHT + share[:, None] * span, atol=1e-9)
    assert (np.diff(share) > 0).all()


def test_line_has_the_number_of_steps_it_was_asked_for():
    waypoints = line(RIGHT, LEFT, 40)
    assert len(waypoints) == 41
    assert np.allclose(np.diff(waypoints, axis=0), (LEFT - RIGHT) / 40)
    assert np.array_equal(waypoints[-1], LEFT)


@pytest.mark.parametrize("steps", [10, 40])
def test_collision_is_named_with_the_waypoint_at_which_it_is(steps):
    response = with_planner("lerp", steps=steps).plan(to_joints(LEFT, RIGHT), wall())
    waypoint = response.attempts[-1].waypoint
    assert f"waypoint {waypoint} of {steps}: " in response.message
    assert 0.2 < waypoint / steps < 0.6
    assert response.fraction == pytest.approx((waypoint - 1) / steps)


def test_another_solution_of_the_pose_is_tried_when_the_way_to_the_nearest_is_blocked(monkeypatch):
    monkeypatch.setattr(lerp, "joint_goals", lambda *_, **__: [LEFT, above(0.4, -0.2, 0.3)])
    response = with_planner("lerp").plan(to_pose(tool_down(0.4, -0.2, 0.3), RIGHT), wall())
    assert np.allclose(last(response), above(0.4, -0.2, 0.3), atol=1e-6)


def test_straight_line_of_the_tool_is_left_to_others():
    response = with_planner("lerp").plan(to_pose(tool_down(0.5, 0.0, 0.3), RIGHT, straight=True), AROUND)
    assert response.error == "no_planner"
    assert "straight line" in response.message


def test_number_of_steps_that_makes_no_sense_is_refused():
    with pytest.raises(ConfigError, match=r"pipeline.planners.lerp.steps"):
        with_planner("lerp", steps=0)
