import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.control.trajectory import Tolerances, checked_trajectory
from common.errors import Refused
from common.hardware.interface import Limits
from common.messages import JointTrajectory, JointTrajectoryPoint

HERE = np.zeros(2)


def check(message: JointTrajectory, limits: Limits, measured: np.ndarray = HERE):  # noqa: ANN201
    return checked_trajectory(message, limits, measured, Tolerances())


def edited(message: JointTrajectory, index: int, **changes: object) -> JointTrajectory:
    points = list(message.points)
    points[index] = points[index].model_copy(update=changes)
    return message.model_copy(update={"points": points})


def code_of(message: JointTrajectory, limits: Limits, measured: np.ndarray = HERE) -> tuple[str, str]:
    with pytest.raises(Refused) as refusal:
        check(message, limits, measured)
    return refusal.value.code, str(refusal.value)


def test_smooth_trajectory_is_accepted_and_passes_through_its_points(limits, rest_to_rest):
    message = rest_to_rest([0, 0], [0.5, -0.3])
    trajectory = check(message, limits)
    for point in message.points[1:-1]:
        q, dq = trajectory.at(point.time_from_start)
        assert np.allclose(q, point.positions) and np.allclose(dq, point.velocities)


def test_joints_in_another_order_are_sorted(limits, rest_to_rest):
    message = rest_to_rest([0, 0], [0.5, -0.3])
    swapped = message.model_copy(update={
        "joint_names": ["elbow", "shoulder"],
        "points": [p.model_copy(update={k: getattr(p, k)[::-1] for k in ("positions", "velocities", "accelerations")})
                   for p in message.points],
    })
    assert np.allclose(check(swapped, limits).positions, check(message, limits).positions)


@pytest.mark.parametrize("names", [["shoulder", "wrist"], ["shoulder", "shoulder"]])
def test_other_joints_are_refused_with_both_lists(limits, rest_to_rest, names):
    code, text = code_of(rest_to_rest([0, 0], [1, 1]).model_copy(update={"joint_names": names}), limits)
    assert code == "joint_names" and "shoulder, elbow" in text


def test_one_joint_of_two_is_refused(limits):
    points = [JointTrajectoryPoint(time_from_start=t, positions=[0], velocities=[0], accelerations=[0]) for t in (0, 1)]
    assert code_of(JointTrajectory(joint_names=["elbow"], points=points), limits)[0] == "joint_names"


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_points_are_refused(limits, rest_to_rest, count):
    message = rest_to_rest([0, 0], [1, 1])
    assert code_of(message.model_copy(update={"points": message.points[:count]}), limits)[0] == "too_few_points"


@pytest.mark.parametrize(("index", "time"), [(0, 0.01), (5, 0.2), (5, 0.1), (20, 0.5)])
def test_times_that_do_not_start_at_zero_and_increase_are_refused(limits, rest_to_rest, index, time):
    assert code_of(edited(rest_to_rest([0, 0], [1, 1]), index, time_from_start=time), limits)[0] == "bad_times"


@pytest.mark.parametrize("field", ["positions", "velocities", "accelerations"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused_naming_point_and_joint(limits, rest_to_rest, field, value):
    code, text = code_of(edited(rest_to_rest([0, 0], [1, 1]), 7, **{field: [0.0, value]}), limits)
    assert code == "not_finite" and "point 7" in text and "elbow" in text


def test_time_that_is_not_finite_is_refused(limits, rest_to_rest):
    assert code_of(edited(rest_to_rest([0, 0], [1, 1]), 7, time_from_start=math.nan), limits)[0] == "not_finite"


@pytest.mark.parametrize("field", ["positions", "velocities", "accelerations"])
def test_point_of_another_length_is_refused(limits, rest_to_rest, field):
    assert code_of(edited(rest_to_rest([0, 0], [1, 1]), 3, **{field: [0.0]}), limits)[0] == "joint_names"


@pytest.mark.parametrize("off", [0.011, -0.5])
def test_start_elsewhere_is_refused_naming_the_joint(limits, rest_to_rest, off):
    code, text = code_of(rest_to_rest([0, 0], [1, 1]), limits, np.array([0.0, off]))
    assert code == "start_mismatch" and "elbow" in text


@pytest.mark.parametrize("index", [0, -1])
def test_end_in_motion_is_refused(limits, rest_to_rest, index):
    assert code_of(edited(rest_to_rest([0, 0], [1, 1]), index, velocities=[0.1, 0.0]), limits)[0] == "not_at_rest"


@pytest.mark.parametrize(
    ("end", "duration", "what"), [([3.1, 0], 9.0, "position"), ([1.5, 0], 1.0, "velocity"), ([0.1, 0], 0.2, "acceler")]
)
def test_limits_exceeded_are_refused_with_value_and_limit(limits, rest_to_rest, end, duration, what):
    code, text = code_of(rest_to_rest([0, 0], end, duration), limits)
    assert code == "limit" and what in text and "shoulder" in text


def test_positions_that_run_ahead_of_velocities_are_refused(limits, rest_to_rest):
    message = rest_to_rest([0, 0], [1, 1], 2.0)
    still = message.model_copy(update={
        "points": [p.model_copy(update={"velocities": [0.0, 0.0]}) for p in message.points]})
    assert code_of(still, limits)[0] == "contradiction"


def test_one_point_that_jumps_is_refused_naming_the_neighbours(limits, rest_to_rest):
    message = rest_to_rest([0, 0], [1, 1], 2.0)
    q = message.points[8].positions
    code, text = code_of(edited(message, 8, positions=[q[0], q[1] + 0.1]), limits)
    assert code == "contradiction" and "points 7 and 8" in text and "elbow" in text


def test_velocity_that_no_acceleration_gives_is_refused(limits, rest_to_rest):
    message = rest_to_rest([0, 0], [0.2, 0], 2.0, points=201)
    assert code_of(edited(message, 100, velocities=[-1.9, 0.0]), limits)[0] == "contradiction"


def test_distant_points_at_rest_are_refused_if_the_motion_between_is_too_fast(limits, rest_to_rest):
    assert code_of(rest_to_rest([0, 0], [1.9, 0], 1.0, points=2), limits)[0] == "limit"


def test_few_points_without_accelerations_are_followed_smoothly(limits, rest_to_rest):
    message = rest_to_rest([0, 0], [1, -1], 3.0, points=6)
    bare = message.model_copy(update={
        "points": [p.model_copy(update={"accelerations": [0.0, 0.0]}) for p in message.points]})
    trajectory = check(bare, limits)
    assert not trajectory.quintic and check(message, limits).quintic
    before = trajectory.at(0.0)[0]
    for t in np.arange(0.0, 3.0, 0.01):
        q, dq = trajectory.at(float(t))
        assert np.all(np.abs(q - before) <= 0.011 * limits.velocity) and np.all(np.abs(dq) <= limits.velocity)
        before = q


@given(
    end=st.tuples(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5)), points=st.integers(2, 60), share=st.floats(0.05, 0.99)
)
def test_every_sampled_quintic_within_limits_is_accepted_and_stays_within(limits, rest_to_rest, end, points, share):
    largest = max(abs(end[0]), abs(end[1]), 1e-3)
    duration = max(1.875 * largest / 2.0, math.sqrt(5.774 * largest / 10.0)) / share
    trajectory = check(rest_to_rest([0, 0], list(end), duration, points), limits)
    for t in np.linspace(0.0, duration, 50):
        q, dq = trajectory.at(float(t))
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


def test_swing_through_a_limit_between_two_points_is_refused(limits):
    """At the limit with some speed, back from it at the next point, and within it again after a quarter of the way."""
    a, speed = 0.9 * limits.acceleration[0], 0.5 * limits.velocity[0]
    rising, span = np.linspace(0, speed / a, 20), 10 * speed / limits.acceleration[0]
    top, back = limits.upper[0], 1.02 * speed * span * 0.5625 / 0.625
    states = [(t, top - speed**2 / a / 2 + a * t**2 / 2, a * t) for t in rising]
    states.append((rising[-1] + span, top - back, 0.0))
    message = JointTrajectory(joint_names=list(limits.names), points=[
        JointTrajectoryPoint(time_from_start=t, positions=[q, 0.0], velocities=[v, 0.0], accelerations=[0.0, 0.0])
        for t, q, v in states])
    code, text = code_of(message, limits, np.array([states[0][1], 0.0]))
    assert code == "limit" and "position after point 19" in text and "shoulder" in text
