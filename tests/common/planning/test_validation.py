from dataclasses import replace

import numpy as np
import pytest

from common.planning.kernel.library import library
from common.planning.path import blended_path
from common.planning.retiming import parametrise
from common.planning.trajectory import TimedPath
from common.planning.validation import check_numbers, validate
from tests.common.planning.requests import above
from tests.common.planning.scenes import HOME, ROBOT, ball, only, scene, world

GOAL = HOME + np.array([0.5, 0.1, -0.2, 0.1, 0, 0.2, 0.3])
V, A = 0.2 * ROBOT.velocity, 0.2 * ROBOT.acceleration


def direct(start, goal, step=None) -> TimedPath:
    path = blended_path(np.array([start, goal]), np.zeros(2))[0]
    return parametrise(path, V, A, **({"step": step} if step else {}))


GOOD = direct(HOME, GOAL)


def fault_of(trajectory: TimedPath, of, step=0.01):
    start = trajectory.positions[0]
    return validate(trajectory, ROBOT, world(of, start), start=start, velocity=V, acceleration=A, step=step)


def changed(field: str, index, value) -> TimedPath:
    array = getattr(GOOD, field).copy()
    array[index] = value
    return replace(GOOD, **{field: array})


def test_sound_trajectory_has_no_fault():
    assert fault_of(GOOD, scene()) is None


@pytest.mark.parametrize(("trajectory", "code"), [
    (changed("times", 3, GOOD.times[2]), "bad_times"),
    (changed("times", 0, 0.001), "bad_times"),
    (changed("positions", (4, 2), np.nan), "not_finite"),
    (changed("velocities", (4, 2), np.inf), "not_finite"),
    (changed("velocities", (-1, 0), 0.1), "not_at_rest"),
    (changed("velocities", (5, 0), V[0] * 1.1), "velocity_limit"),
    (changed("accelerations", (5, 1), -A[1] * 1.1), "acceleration_limit"),
    (changed("positions", (5, 0), GOOD.positions[5, 0] + 0.2), "velocity_limit"),
    (changed("velocities", (5, 6), GOOD.velocities[5, 6] + 0.09), "inconsistent"),
    (TimedPath(GOOD.times[:1], GOOD.positions[:1], GOOD.velocities[:1], GOOD.accelerations[:1]), "bad_trajectory"),
])
def test_trajectory_that_a_controller_would_refuse_is_found(trajectory, code):
    assert check_numbers(trajectory, ROBOT, start=HOME, velocity=V, acceleration=A).code == code


def test_wrong_start_and_position_outside_a_limit_are_found():
    fault = check_numbers(GOOD, ROBOT, start=HOME + 0.01 * np.eye(7)[2], velocity=V, acceleration=A)
    assert fault.code == "start_mismatch" and "panda_joint3" in fault.message
    away = 3.0 * np.eye(7)[6]
    outside = replace(GOOD, positions=GOOD.positions + away)
    assert check_numbers(outside, ROBOT, start=HOME + away, velocity=V, acceleration=A).code == "position_limit"


def test_collision_between_states_is_found_with_waypoint_and_pair():
    start, goal = above(0.48, -0.2, 0.2), above(0.48, 0.2, 0.2)
    fault = fault_of(direct(start, goal, step=0.5), only(ball(0, *ROBOT.fk((start + goal) / 2)[:3, 3])))
    assert (fault.code, fault.colliding[1]) == ("collision", "ball_0")
    assert f"waypoint {fault.waypoint} of" in fault.message


@pytest.mark.skipif(library() is None, reason="the planning kernel is not built")
def test_kernel_finds_a_collision_between_checked_states():
    turned = 1.6 * np.eye(7)[0]
    positions, still = np.stack([HOME, HOME + turned]), np.zeros((2, 7))
    swing = TimedPath(np.array([0.0, 10.0]), positions, still, 0.06 * np.stack([turned, -turned]))
    x, y, z = ROBOT.fk(HOME + 0.5 * turned)[:3, 3]
    palm = only(ball(0, x, y, z + 0.06))
    assert not any(world(palm).collides(q) for q in positions) and world(palm).collides(HOME + 0.5 * turned)
    fault = fault_of(swing, palm, step=100.0)
    assert fault is not None and (fault.code, fault.waypoint) == ("collision", 0) and "ball_0" in fault.colliding
