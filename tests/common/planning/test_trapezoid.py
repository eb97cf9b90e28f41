import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.planning.planners.ptp import synchronised, trapezoid
from common.planning.trajectory import end_accelerations

values = st.floats(0.01, 10)


@given(length=values, speed=values, acceleration=values, deceleration=values)
def test_profile_covers_the_length_within_its_limits(length, speed, acceleration, deceleration):
    profile = trapezoid(length, speed, acceleration, deceleration)
    times = np.linspace(0, profile.duration, 200)
    s, ds, dds = np.array([profile.at(t) for t in times]).T
    assert s[0] == 0
    assert s[-1] == pytest.approx(length)
    assert ds[-1] == pytest.approx(0, abs=1e-9)
    assert ds.max() <= speed * (1 + 1e-9)
    assert dds.max() <= acceleration * (1 + 1e-9)
    assert dds.min() >= -deceleration * (1 + 1e-9)
    assert (np.diff(s) >= -1e-9).all()
    step = times[1]
    assert np.allclose(np.diff(s), 0.5 * step * (ds[1:] + ds[:-1]), atol=(acceleration + deceleration) * step**2)


joints = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)


@given(start=joints, goal=joints, braking=st.floats(0.1, 1))
def test_joints_move_together_and_the_slowest_is_at_its_limit(start, goal, braking):
    velocity, acceleration = np.array([1.0, 2.0, 0.5]), np.array([3.0, 1.0, 2.0])
    timed = synchronised(start, goal, velocity, acceleration, braking * acceleration)
    assert np.allclose(timed.positions[[0, -1]], [start, goal])
    begin, end = end_accelerations(timed)
    for found in (begin, end):
        assert (found <= acceleration * (1 + 1e-6) + 1e-6).all()
        assert (found >= -acceleration * (1 + 1e-6) - 1e-6).all()
    assert (np.abs(timed.velocities) <= velocity * (1 + 1e-9)).all()
    if np.abs(goal - start).max() > 1e-3:
        share = [
            (np.abs(timed.velocities) / velocity).max(),
            (np.abs(begin[0]) / acceleration).max(),
            (np.abs(end[-1]) / (braking * acceleration)).max(),
        ]
        assert max(share) == pytest.approx(1, abs=1e-3)
