import numpy as np
import pytest

from common.hardware.interface import Limits
from common.hardware.streaming import SetPointStream, hermite

AHEAD, PERIOD = 0.05, 0.01
TWO = np.ones(2)
LIMITS = Limits(("shoulder", "elbow"), -3 * TWO, 3 * TWO, 2 * TWO, 10 * TWO, 20 * TWO, 400 * TWO)


def wave(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities that begin at rest at 0."""
    return 0.5 * TWO * (1 - np.cos(2 * time)), TWO * np.sin(2 * time)


def played(until: float, sent: float | None = None, jitter: float = 0.0) -> tuple[np.ndarray, SetPointStream]:
    """What is played each millisecond of a wave whose set-points are sent up to a time."""
    stream, random = SetPointStream(LIMITS, AHEAD), np.random.default_rng(1)
    stream.begin(0 * TWO, 0.0)
    rows, due, number = [], 0.0, 0
    for now in np.arange(0.0, until, 1e-3):
        while due <= now and (sent is None or number * PERIOD <= sent):
            stream.put(number * PERIOD, *wave(number * PERIOD))
            number += 1
            due = number * PERIOD + jitter * random.random()
        rows.append(stream.at(float(now))[0])
    return np.array(rows), stream


@pytest.mark.parametrize("jitter", [0.0, 0.04])
def test_the_motion_is_played_as_it_was_sent_whether_set_points_come_evenly_or_not(jitter: float) -> None:
    q, stream = played(3.0, jitter=jitter)
    times = np.arange(0.0, 3.0, 1e-3) - AHEAD
    wanted = np.array([wave(max(0.0, time))[0] for time in times])
    assert np.abs(q - wanted).max() < 1e-5 and not stream.ceased


def test_set_points_that_cease_in_the_middle_end_in_rest_within_the_limits() -> None:
    q, stream = played(2.0, sent=0.6)
    assert "ceased to come" in stream.ceased
    v, a, j = (np.diff(q, n, axis=0) / 1e-3**n for n in (1, 2, 3))
    assert np.abs(v).max() <= 2.0 and not v[-500:].any()
    assert np.abs(a).max() <= 20 * 1.01 and np.abs(j[100:]).max() <= 400 * 1.05
    ended = float(q[-1, 0])
    stream.put(2.0, *wave(2.0))
    assert stream.at(2.1)[0][0] == ended, "what comes later would begin elsewhere"
    stream.begin(q[-1], 2.2)
    stream.put(2.21, q[-1], 0 * TWO)
    assert not stream.ceased and np.allclose(stream.at(2.4)[0], q[-1])


def test_a_rest_may_last() -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(TWO, 0.0)
    assert np.array_equal(stream.at(100.0)[0], TWO) and not stream.ceased
    for n in range(3):
        stream.put(100.0 + n * PERIOD, TWO, 0 * TWO)
    stream.put(100.03, 1.01 * TWO, 0 * TWO)
    assert not stream.ceased
    before = [stream.at(100.02 + AHEAD)[0], stream.at(100.025 + AHEAD)[0]]
    assert np.array_equal(before[0], TWO), "it moves no earlier than it was told to"
    assert np.allclose(before[1], hermite(0.5, PERIOD, TWO, 0 * TWO, 1.01 * TWO, 0 * TWO)[0])


def test_a_driver_that_is_held_up_in_the_middle_leaves_the_arm_where_it_has_stopped() -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(0 * TWO, 0.0)
    for n in range(60):
        stream.put(n * PERIOD, *wave(n * PERIOD))
    for now in np.arange(0.0, 0.3, 2e-3):
        q, dq = stream.at(float(now))
    assert dq[0] > 0.3
    after = [stream.at(t) for t in (0.4, 0.402, 0.5)]
    assert "held up for 10" in stream.ceased
    assert all(np.array_equal(p, q) and not v.any() for p, v in after), "no jump to where it would be"


@pytest.mark.parametrize("jump", [0.5, np.nan, np.inf])
def test_a_jump_is_not_played(jump: float) -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(0 * TWO, 0.0)
    stream.put(0.01, 0 * TWO, 0 * TWO)
    stream.put(0.02, np.array([0.0, jump]), 0 * TWO)
    assert "elbow would jump" in stream.ceased
    assert all(not stream.at(t)[0].any() for t in (0.05, 0.1, 1.0))


def test_what_is_older_than_what_came_before_is_left_out() -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(0 * TWO, 0.0)
    stream.put(0.02, 0.01 * TWO, 0 * TWO)
    stream.put(0.01, 5 * TWO, 0 * TWO)
    assert not stream.ceased and stream.at(1.0)[0][0] == pytest.approx(0.01)
