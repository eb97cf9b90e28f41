"""The curve through set-points that arrive ahead of time: on time, irregularly, with gaps, or with a player held up."""

import math

import numpy as np
import pytest

from common.hardware.interface import Limits
from common.hardware.streaming import SetPointStream

AHEAD, PERIOD = 0.05, 0.01
TWO = np.ones(2)
LIMITS = Limits(("shoulder", "elbow"), -3 * TWO, 3 * TWO, 2 * TWO, 10 * TWO, 20 * TWO, 400 * TWO)
SWING = Limits(("shoulder", "elbow"), -3 * TWO, 3 * TWO, 2 * TWO, 6 * TWO, 12 * TWO, 120 * TWO)


def wave(time):
    """Positions and velocities that begin at rest at 0."""
    return 0.5 * TWO * (1 - np.cos(2 * time)), TWO * np.sin(2 * time)


def swing(time):
    """The second joint does twice what the first one does; rest, 1 s of motion at 90 % of a limit, and rest again."""
    u = min(max(time - 0.1, 0.0), 1.0)
    q, dq = u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2
    return q * np.array([0.45, 0.9]), dq * np.array([0.45, 0.9])


def bang(time):
    """0.4 s of motion by a jerk of 400 rad/s^3 that brings the acceleration up to its limit of 10 rad/s^2, and back."""
    q, dq, ddq, began = 0.0, 0.0, 0.0, 0.0
    for duration, jerk in ((0.025, 400), (0.15, 0), (0.05, -400), (0.15, 0), (0.025, 400)):
        step = min(max(time - began, 0.0), duration)
        q += step * dq + step**2 / 2 * ddq + step**3 / 6 * jerk
        dq, ddq, began = dq + step * ddq + step**2 / 2 * jerk, ddq + step * jerk, began + duration
    return q * TWO, dq * TWO


def resting(limits=LIMITS, period=1e-3):
    stream = SetPointStream(limits, AHEAD, period)
    stream.begin(0 * TWO, 0.0)
    return stream


def play(motion, until, limits=LIMITS, period=1e-3, sent=math.inf, jitter=0.0, gaps=None):
    """Play a motion of which a set-point is sent each 10 ms: times, set-points, delays, stream.

    Args:
        motion: positions and velocities at a time [s].
        sent: time of the last set-point.
        jitter: largest delay of a set-point [s].
        gaps: times without a request of the arm [s], by their begin.
    """
    stream, random, left = resting(limits, period), np.random.default_rng(1), sorted((gaps or {}).items())
    rows, due, number, now = [], 0.0, 0, 0.0
    while now < until:
        while due <= now + 1e-9 and number * PERIOD <= sent:
            stream.put(number * PERIOD, *motion(number * PERIOD))
            number += 1
            due = number * PERIOD + jitter * random.random()
        q, dq = stream.at(now)
        if gaps and stream.ceased and not dq.any():
            break  # a controller would start again where the arm is
        rows.append((now, q, stream.behind))
        now += left.pop(0)[1] if left and left[0][0] <= now else period
    times, q, behind = (np.array(each) for each in zip(*rows, strict=True))
    return times, q, behind, stream


def largest(q, n):
    """Return the largest n-th derivative of set-points each millisecond."""
    return np.abs(np.diff(q, n, axis=0)).max() / 1e-3**n


@pytest.mark.parametrize("jitter", [0.0, 0.04])
def test_motion_is_played_as_sent_even_if_set_points_arrive_irregularly(jitter):
    times, q, _, stream = play(wave, 3.0, jitter=jitter)
    wanted = np.array([wave(max(0.0, time - AHEAD))[0] for time in times])
    assert np.abs(q - wanted).max() < 1e-5 and not stream.ceased
    assert np.abs(q - wanted)[times > AHEAD + PERIOD].max() < 1e-8, "but for its beginning, which no arm could follow"


def test_interpolation_at_the_arms_rate_keeps_the_accelerations_of_the_motion():
    _, q, _, _ = play(bang, 0.6)
    assert 9.9 < largest(q, 2) <= 10 * 1.03 and largest(q, 3) <= 400 * 1.3, "with cubics it would be a jerk of 617"
    assert q[-1][0] == pytest.approx(bang(1.0)[0][0], abs=1e-12)


def test_ceasing_set_points_lead_to_rest_within_the_limits():
    _, q, _, stream = play(wave, 2.0, sent=0.6)
    assert "ceased to come" in stream.ceased
    assert largest(q, 1) <= 2.0 and not np.diff(q[-500:], axis=0).any()
    assert largest(q, 2) <= 20 * 1.01 and largest(q[100:], 3) <= 400 * 1.05
    stream.put(2.0, *wave(2.0))
    assert np.array_equal(stream.at(2.1)[0], q[-1]), "later set-points would start elsewhere"
    stream.begin(q[-1], 2.2)
    stream.put(2.21, q[-1], 0 * TWO)
    assert not stream.ceased and np.allclose(stream.at(2.4)[0], q[-1])


def test_long_rest_is_no_fault():
    stream = SetPointStream(LIMITS, AHEAD, PERIOD / 2)
    stream.begin(TWO, 0.0)
    assert np.array_equal(stream.at(100.0)[0], TWO) and not stream.ceased
    for n, q in enumerate((1.0, 1.0, 1.0, 1.01)):
        stream.put(100.0 + n * PERIOD, q * TWO, 0 * TWO)
    assert not stream.ceased
    before = [stream.at(100.02 + AHEAD)[0], stream.at(100.025 + AHEAD)[0]]
    assert np.array_equal(before[0], TWO), "it does not move early"
    assert np.all(before[1] > TWO) and np.all(before[1] < 1.005 * TWO), "it begins with no acceleration"


def test_nearby_rest_is_reached_once():
    _, q, _, _ = play(lambda time: (5e-4 * TWO, 0 * TWO), 0.3)
    v = np.diff(q, axis=0)
    assert v.min() >= 0.0 and not v[60:].any() and np.allclose(q[-1], 5e-4)
    assert largest(q, 2) <= 10.0 and largest(q, 3) <= 400.0


@pytest.mark.parametrize(("q", "dq", "reason"), [
    ([0.0, 0.5], [0.0, 0.0], "elbow would jump"), ([0.0, np.inf], [0.0, 0.0], "elbow would jump"),
    ([np.nan, np.nan], [0.0, 0.0], "shoulder would jump"),
    ([0.0, 0.0], [np.nan, np.nan], "the velocity of shoulder is no finite number"),
    ([0.0, 0.0], [np.inf, 0.0], "the velocity of shoulder is no finite number"),
])
def test_jump_or_not_a_number_is_not_played(q, dq, reason):
    stream = resting()
    for n in range(20):
        stream.put(n * PERIOD, *((0 * TWO, 0 * TWO) if n < 10 else (np.array(q), np.array(dq))))
        assert not stream.at(n * PERIOD)[0].any()
    assert reason in stream.ceased and not stream.at(0.3)[0].any()


# --- a player that is held up ---


def assert_each_step_within_limits(times, q):
    """Each set-point is one period from the one before, for an arm whose speed only falls while it gets none."""
    v = np.diff(q, axis=0) / 2e-3
    fresh = np.diff(times) < 3e-3
    assert np.abs(v).max() <= 2.0 * 1.001
    for n in np.flatnonzero(~fresh):
        assert np.all(v[n] * v[n - 1] >= 0), "it never goes back"
        assert np.all(np.abs(v[n]) <= np.abs(v[n - 1]) + 6 * 1.02 * 2e-3), "nor is it faster after a gap than before"
    a, evenly = np.diff(v, axis=0) / 2e-3, fresh[1:] & fresh[:-1]
    braking = 1.0 if evenly.all() else 2.0
    assert np.abs(a[evenly]).max() <= 6 * braking * 1.001
    j, evenly = np.diff(a, axis=0) / 2e-3, evenly[1:] & evenly[:-1]
    assert np.abs(j[evenly]).max() <= 120 * 1.05


@pytest.mark.parametrize("gap", [0.005, 0.01, 0.02, 0.04, 0.08])
def test_held_up_driver_ramps_up_from_where_it_was(gap):
    times, q, _, stream = play(swing, 2.0, SWING, 2e-3, gaps={0.6: gap})
    assert_each_step_within_limits(times, q)
    assert not stream.ceased and np.allclose(q[:, 1], 2 * q[:, 0]), "it stays on the path"
    assert np.allclose(q[-1], swing(9.0)[0]) and stream.behind == 0.0
    assert (np.abs(np.diff(q[:, 0])) > 0).sum() * 2e-3 < 1.35, "nor does it take its time"


@pytest.mark.parametrize("seed", [0, 1, 2, 5, *(pytest.param(n, marks=pytest.mark.campaign) for n in range(6, 40))])
def test_no_hold_up_makes_a_set_point_exceed_a_limit(seed):
    random = np.random.default_rng(seed)
    gaps = {float(time): float(random.uniform(0.005, 0.2 if seed % 2 else 0.04)) for time in random.uniform(0, 1.2, 8)}
    times, q, _, stream = play(swing, 2.5, SWING, 2e-3, gaps=gaps)
    assert_each_step_within_limits(times, q)
    assert np.allclose(q[:, 1], 2 * q[:, 0], atol=1e-3 if stream.ceased else 1e-9)
    assert stream.ceased or np.allclose(q[-1], swing(9.0)[0])


def test_delay_is_made_up_where_limits_leave_room_and_at_rest():
    def slow(time):
        q, dq = swing(time / 5)
        return q, dq / 5

    times, _, behind, _ = play(slow, 6.0, SWING, 2e-3, gaps={2.0: 0.03})
    assert 0.028 < behind.max() < 0.1
    assert behind[times > 3.0].max() <= 2.1e-3, "of the motion that ends at 5.6 s"


def test_repeated_hold_ups_end_the_motion_before_a_stop_would_be_late():
    times, q, _, stream = play(swing, 4.0, SWING, 2e-3, gaps={0.2 + n * 1e-6: 0.08 for n in range(12)})
    assert_each_step_within_limits(times, q)
    assert "held up too often: it is 3" in stream.ceased


def test_long_hold_up_leaves_the_arm_where_it_has_stopped():
    _, q, _, stream = play(wave, 0.3, period=2e-3)
    assert q[-1][0] - q[-2][0] > 0.3 * 2e-3
    after = [stream.at(t) for t in (0.4, 0.402, 0.5)]
    assert "held up for 10" in stream.ceased
    assert all(np.array_equal(p, q[-1]) and not v.any() for p, v in after), "no jump to where it would be"


def test_set_point_older_than_the_newest_is_ignored():
    stream = resting(period=2e-3)
    stream.put(0.02, 0.01 * TWO, 0 * TWO)
    stream.put(0.01, 5 * TWO, 0 * TWO)
    q = [stream.at(float(now))[0][0] for now in np.arange(0.0, 1.0, 2e-3)]
    assert not stream.ceased and q[-1] == pytest.approx(0.01)


@pytest.mark.parametrize("at_rest", [False, True])
def test_set_points_after_a_gap_do_not_move_the_arm(at_rest):
    stream, rows = resting(), []
    for number in range(31):
        stream.put(number * PERIOD, *wave(number * PERIOD))
        rows += [stream.at(number * PERIOD + each * 1e-3)[0] for each in range(10)]
    q, _ = wave(0.3)
    if at_rest:  # all at once, as when a stopped program ends
        stream.put(0.31, q, 0 * TWO)
    measured = rows[-1]
    for number in range(30):  # the controller and its clock had stopped for a second
        stream.put(1.3 + number * PERIOD, measured, 0 * TWO)
    rows += [stream.at(0.31 + tick * 1e-3)[0] for tick in range(1200)]
    assert bool(stream.ceased) != at_rest and "for 1000 ms" in (stream.ceased or "for 1000 ms")
    assert np.min(rows) > -1e-6 and np.max(rows) < q.max() + 0.05
    assert largest(rows, 1) <= LIMITS.velocity[0] and np.abs(rows[-1] - rows[-50]).max() < 1e-3
