"""The limiter keeps any set-points within limits, and does not alter those that are within them."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from common.control.limiter import POSITION_SLACK, Limiter
from common.hardware.interface import Limits

PERIOD = 0.01
LIMITS = Limits(
    ("shoulder", "elbow"), np.array([-2.0, -1.0]), np.array([2.0, 3.0]), np.array([2.0, 3.0]), np.array([5.0, 15.0]),
    np.array([10.0, 15.0]), np.array([500.0, 7500.0]))
STILL = np.zeros(2)
CYCLES, PAIR, OR_FAR = st.integers(1, 40), {"min_size": 2, "max_size": 2}, st.floats(-3, 3)


def assert_within(positions, limits=LIMITS, share=1.0, acceleration=None, period=PERIOD):
    """Check the differences between set-points."""
    most = limits.acceleration if acceleration is None else acceleration
    q = np.array(positions)
    assert np.all(q >= limits.lower - 1.1 * POSITION_SLACK) and np.all(q <= limits.upper + 1.1 * POSITION_SLACK)
    v = np.diff(q, axis=0) / period
    a = np.diff(v, axis=0) / period
    assert np.all(np.abs(v) <= share * limits.velocity * 1.021), np.abs(v).max(axis=0)
    assert np.all(np.abs(a) <= most * 1.021 + 1e-6), np.abs(a).max(axis=0)
    # Planned steps of acceleration, from one that is allowed to another, may be a cycle short.
    assert np.all(np.abs(np.diff(a, axis=0)) <= np.maximum(limits.jerks * period, 2 * most) * 1.021 + 1e-6)


@pytest.fixture
def limiter():
    return Limiter(LIMITS, STILL, PERIOD)


def swing(times, share):
    """Positions and velocities (2,) of both joints at times, within a share of the acceleration limits."""
    w = np.array([1.7, 2.3])
    amplitude = share * np.minimum(LIMITS.acceleration / w**2, LIMITS.velocity / w) / 2
    return [(amplitude * (1 - np.cos(w * t)), amplitude * w * np.sin(w * t)) for t in times]


def test_set_points_within_limits_pass_unaltered(limiter):
    for q, dq in swing(np.arange(1, 1000) * PERIOD, 0.7):
        given, velocity = limiter.step(q, dq, PERIOD)
        assert given is q and velocity is dq


def test_full_acceleration_to_full_deceleration_within_a_cycle_passes(limiter):
    a, top = 0.98 * LIMITS.acceleration, 0.15
    for t in np.arange(1, 80) * PERIOD:
        late = max(t - top, 0.0)
        q, v = a * t**2 / 2 - a * late**2, a * t - 2 * a * late
        if t > 2 * top:
            q, v = a * top**2, STILL
        assert limiter.step(q, v, PERIOD)[0] is q


@given(
    jumps=st.lists(st.tuples(CYCLES, st.lists(st.floats(-1e3, 1e3) | OR_FAR, **PAIR), st.lists(
        st.floats(-30, 30), **PAIR)), min_size=1, max_size=12),
    share=st.sampled_from([1.0, 0.3, 0.05]),
)
@example(  # ruckig finds no profile for a way back that is so short
    jumps=[(27, [0.0, 4.28960194463659e-08], [0.0, -3.0]), (3, [0.0, 0.0], [0.0, -3.0])], share=1.0
)
def test_any_requests_become_set_points_within_limits(jumps, share):
    limiter = Limiter(LIMITS, STILL, PERIOD)
    sent = [STILL, STILL, STILL]
    for count, target, velocity in jumps:
        sent += [limiter.step(np.array(target), np.array(velocity), PERIOD, share)[0] for _ in range(count)]
    assert_within(sent, share=share)


@pytest.mark.parametrize("rested", range(4))
@pytest.mark.parametrize("begin", [0.0, 0.3, 0.9])
def test_after_rest_set_points_start_as_from_rest(limiter, rested, begin):
    braking = 0.9 * LIMITS.acceleration
    for k in range(15):  # up, and down again, at rest within a cycle
        limiter.step(braking * (k * PERIOD) ** 2 / 2, braking * k * PERIOD, PERIOD)
    q, dq = limiter.position, braking * 14 * PERIOD
    ends = (14 - begin) * PERIOD  # from now on
    for t in np.arange(1, 15 + rested) * PERIOD:
        u = min(t, ends)
        asked = q + dq * u - dq / ends * u**2 / 2
        assert limiter.step(asked, dq * (1 - u / ends), PERIOD, braking=True)[0] is asked
    _, velocity = limiter.go_at(-LIMITS.velocity, PERIOD)
    assert np.all(np.abs(velocity) <= LIMITS.acceleration * PERIOD * (2 if rested == 0 else 1) * 1.001)


@pytest.mark.parametrize("strange", [np.nan, np.inf, -np.inf])
def test_not_a_number_moves_nothing(limiter, strange):
    for _ in range(20):
        q, dq = limiter.step(np.array([strange, 0.0]), np.array([strange, 0.0]), PERIOD)
        assert np.array_equal(q, STILL) and np.array_equal(dq, STILL)


def test_requested_set_points_are_reached_again_and_then_followed_exactly(limiter):
    wanted = swing(1.0 + np.arange(1, 1000) * PERIOD, 0.3)  # begins far away
    sent = [STILL, STILL, STILL, *(limiter.step(q, dq, PERIOD)[0] for q, dq in wanted)]
    assert np.array_equal(sent[-1], wanted[-1][0])
    assert_within(sent)



@pytest.mark.parametrize("beyond", [0.0, 0.0005, 0.03])
@pytest.mark.parametrize("speed", [0.001, 0.02])
def test_no_joint_creeps_beyond_its_limit(beyond, speed):
    """In steps that are small enough to be within all other limits, as a jog or a forged trajectory has them."""
    start = LIMITS.upper + beyond
    limiter, target = Limiter(LIMITS, start, PERIOD), start
    for _ in range(int(6 * POSITION_SLACK / (speed * PERIOD))):
        target = target + speed * PERIOD
        position, _ = limiter.step(target, np.full(2, speed), PERIOD)
        assert np.all(position <= np.maximum(start + 1e-8, LIMITS.upper + 1.1 * POSITION_SLACK)), position - start


@given(
    out=st.lists(st.floats(-0.1, 0.1), **PAIR),
    steps=st.lists(st.tuples(CYCLES, st.lists(st.floats(-0.04, 0.04) | OR_FAR, **PAIR), st.booleans()), min_size=1,
                   max_size=12),
)
def test_joint_beyond_its_limit_moves_no_farther_at_any_speed_or_jump(out, steps):
    start = np.where(np.array(out) > 0, LIMITS.upper, LIMITS.lower) + out
    limiter, farthest = Limiter(LIMITS, start, PERIOD), np.abs(out)
    for count, speed, jumps in steps:
        for _ in range(count):
            asked = np.array(speed)
            target = start + asked if jumps else limiter.position + asked * PERIOD
            position, _ = limiter.step(target, STILL if jumps else asked, PERIOD)
            excess = np.maximum(LIMITS.lower - position, position - LIMITS.upper)
            assert np.all(excess <= np.maximum(farthest + 1e-8, 1.1 * POSITION_SLACK))
