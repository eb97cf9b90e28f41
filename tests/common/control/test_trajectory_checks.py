"""Checks of a trajectory before it is followed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.control.trajectory import Tolerances, checked_trajectory
from common.errors import Refused
from common.messages import JointTrajectory, JointTrajectoryPoint
from tests.common.control.trajectories import rest_to_rest, trajectory

FIELDS = ["positions", "velocities", "accelerations"]
MOVE, SLOW = rest_to_rest([0, 0], [1, 1]), rest_to_rest([0, 0], [1, 1], 2.0)


def check(message, limits, measured=(0.0, 0.0)):
    return checked_trajectory(message, limits, np.array(measured), Tolerances())


def assert_refused(message, limits, code, words=(), measured=(0.0, 0.0)):
    with pytest.raises(Refused) as refusal:
        check(message, limits, measured)
    assert refusal.value.code == code and all(word in str(refusal.value) for word in words)


def edited(message, index, **changes):
    points = list(message.points)
    points[index] = points[index].model_copy(update=changes)
    return message.model_copy(update={"points": points})


def with_all(message, **changes):
    return message.model_copy(update={"points": [point.model_copy(update=changes) for point in message.points]})


def test_smooth_trajectory_is_accepted_and_passes_through_its_points_in_any_order_of_joints(limits):
    message = rest_to_rest([0, 0], [0.5, -0.3])
    accepted = check(message, limits)
    for point in message.points[1:-1]:
        q, dq = accepted.at(point.time_from_start)
        assert np.allclose(q, point.positions) and np.allclose(dq, point.velocities)
    swapped = message.model_copy(update={"joint_names": ["elbow", "shoulder"], "points": [
        point.model_copy(update={field: getattr(point, field)[::-1] for field in FIELDS}) for point in message.points]})
    assert np.allclose(check(swapped, limits).positions, accepted.positions)


@pytest.mark.parametrize(("message", "code", "words"), [
    (MOVE.model_copy(update={"joint_names": ["shoulder", "wrist"]}), "joint_names", ["shoulder, elbow"]),
    (MOVE.model_copy(update={"joint_names": ["shoulder", "shoulder"]}), "joint_names", ["shoulder, elbow"]),
    (trajectory([(0, [0]), (1, [0])], ["elbow"]), "joint_names", []),
    *[(edited(MOVE, 3, **{field: [0.0]}), "joint_names", []) for field in FIELDS],
    *[(MOVE.model_copy(update={"points": MOVE.points[:count]}), "too_few_points", []) for count in (0, 1)],
    *[(edited(MOVE, index, time_from_start=time), "bad_times", [])
      for index, time in ((0, 0.01), (5, 0.2), (5, 0.1), (20, 0.5))],
    *[(edited(MOVE, 7, **{field: [0.0, value]}), "not_finite", ["point 7", "elbow"])
      for field in FIELDS for value in (math.nan, math.inf)],
    (edited(MOVE, 7, time_from_start=math.nan), "not_finite", []),
    *[(edited(MOVE, index, velocities=[0.1, 0.0]), "not_at_rest", []) for index in (0, -1)],
    (rest_to_rest([0, 0], [3.1, 0], 9.0), "limit", ["position", "shoulder"]),
    (rest_to_rest([0, 0], [1.5, 0], 1.0), "limit", ["velocity", "shoulder"]),
    (rest_to_rest([0, 0], [0.1, 0], 0.2), "limit", ["acceler", "shoulder"]),
    (rest_to_rest([0, 0], [1.9, 0], 1.0, points=2), "limit", []),  # too fast between the points
    (with_all(SLOW, velocities=[0.0, 0.0]), "contradiction", []),
    (edited(SLOW, 8, positions=[SLOW.points[8].positions[0], SLOW.points[8].positions[1] + 0.1]), "contradiction",
     ["points 7 and 8", "elbow"]),
    (edited(rest_to_rest([0, 0], [0.2, 0], 2.0, points=201), 100, velocities=[-1.9, 0.0]), "contradiction", []),
])
def test_unsuitable_trajectory_is_refused_with_a_reason(limits, message, code, words):
    assert_refused(message, limits, code, words)


@pytest.mark.parametrize("off", [0.011, -0.5])
def test_start_away_from_the_measured_position_is_refused(limits, off):
    assert_refused(MOVE, limits, "start_mismatch", ["elbow"], (0.0, off))


def test_swing_through_a_limit_between_two_points_is_refused(limits):
    """At the limit with some speed, back from it at the next point, and within it again after a quarter of the way."""
    a, speed = 0.9 * limits.acceleration[0], 0.5 * limits.velocity[0]
    rising, span = np.linspace(0, speed / a, 20), 10 * speed / limits.acceleration[0]
    top, back = limits.upper[0], 1.02 * speed * span * 0.5625 / 0.625
    rows = [(t, [top - speed**2 / a / 2 + a * t**2 / 2, 0.0], [a * t, 0.0]) for t in rising]
    message = trajectory([*rows, (rising[-1] + span, [top - back, 0.0])])
    assert_refused(message, limits, "limit", ["position after point 19", "shoulder"], rows[0][1])


def test_few_points_without_accelerations_are_followed_smoothly(limits):
    message = rest_to_rest([0, 0], [1, -1], 3.0, points=6)
    smooth = check(with_all(message, accelerations=[0.0, 0.0]), limits)
    assert not smooth.quintic and check(message, limits).quintic
    q, dq = np.transpose([smooth.at(float(t)) for t in np.arange(0.0, 3.0, 0.01)], (1, 0, 2))
    assert np.all(np.abs(np.diff(q, axis=0)) <= 0.011 * limits.velocity) and np.all(np.abs(dq) <= limits.velocity)


@given(
    end=st.tuples(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5)), points=st.integers(2, 60), share=st.floats(0.05, 0.99)
)
def test_every_sampled_quintic_within_limits_is_accepted_and_stays_within(limits, end, points, share):
    largest = max(abs(end[0]), abs(end[1]), 1e-3)
    duration = max(1.875 * largest / 2.0, math.sqrt(5.774 * largest / 10.0)) / share
    accepted = check(rest_to_rest([0, 0], end, duration, points), limits)
    for t in np.linspace(0.0, duration, 50):
        q, dq = accepted.at(float(t))
        assert np.all(np.abs(q) <= largest + 1e-6) and np.all(np.abs(dq) <= 1.02 * limits.velocity + 1e-9)


@given(st.data())
def test_random_numbers_never_crash_the_checks(limits, data):
    number = st.floats(-1e9, 1e9) | st.sampled_from([math.nan, math.inf, -math.inf, 0.0])
    row = st.lists(number, min_size=2, max_size=2)
    points = data.draw(st.lists(st.builds(
        JointTrajectoryPoint.model_construct, time_from_start=number, positions=row, velocities=row, accelerations=row
    ), max_size=4))
    message = JointTrajectory.model_construct(joint_names=["shoulder", "elbow"], points=points)
    with pytest.raises(Refused):
        check(message, limits)
        raise Refused("taken", "by chance")
