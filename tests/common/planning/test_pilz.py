"""Point to point, straight lines and arcs with trapezoidal profiles."""

import numpy as np

from common.planning.retiming import end_accelerations
from tests.common.planning.planner_checks import AROUND, LEFT, RIGHT, assert_sound, wall, with_planner
from tests.common.planning.planning_scenes import CELL, ROBOT, to_joints


def test_point_to_point_has_three_phases_and_all_joints_share_them():
    pipeline = with_planner("ptp", deceleration=0.5)
    request = to_joints(LEFT, RIGHT)
    timed = assert_sound(pipeline, request, AROUND, pipeline.plan(request, AROUND))
    assert len(timed.times) == 4
    begin, end = end_accelerations(timed)
    assert np.allclose(begin, end, atol=1e-6)
    assert np.allclose(begin[1], 0, atol=1e-6)
    assert np.allclose(np.abs(begin[2]), 0.5 * np.abs(begin[0]), rtol=1e-3, atol=1e-6)
    limit = CELL.motion.velocity_scaling * ROBOT.velocity
    assert 0.97 < (np.abs(timed.velocities) / limit).max() <= 1


def test_point_to_point_names_the_waypoint_of_a_collision():
    response = with_planner("ptp", steps=20).plan(to_joints(LEFT, RIGHT), wall())
    assert f"waypoint {response.attempts[-1].waypoint} of 20" in response.message
