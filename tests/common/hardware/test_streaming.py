import numpy as np
import pytest

from common.hardware.interface import Limits
from common.hardware.streaming import SetPointStream

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
def test_motion_is_played_as_sent_even_if_set_points_arrive_irregularly(jitter: float) -> None:
    q, stream = played(3.0, jitter=jitter)
    times = np.arange(0.0, 3.0, 1e-3) - AHEAD
    wanted = np.array([wave(max(0.0, time))[0] for time in times])
    assert np.abs(q - wanted).max() < 1e-5 and not stream.ceased
    assert np.abs(q - wanted)[times > PERIOD].max() < 1e-8, "but for its beginning, which no arm could follow"


def bang(time: float) -> tuple[np.ndarray, np.ndarray]:
    """0.4 s of motion by a jerk of 400 rad/s^3 that brings the acceleration up to its limit of 10 rad/s^2, and back."""
    q, dq, ddq = 0.0, 0.0, 0.0
    for ends, jerk in ((0.025, 400), (0.175, 0), (0.225, -400), (0.375, 0), (0.4, 400)):
        step = min(max(time - ends + BANG[ends], 0.0), BANG[ends])
        q += step * dq + step**2 / 2 * ddq + step**3 / 6 * jerk
        dq, ddq = dq + step * ddq + step**2 / 2 * jerk, ddq + step * jerk
    return q * TWO, dq * TWO


BANG = {0.025: 0.025, 0.175: 0.15, 0.225: 0.05, 0.375: 0.15, 0.4: 0.025}  # [s] duration of each part, by its end


def test_interpolation_at_the_arms_rate_keeps_the_accelerations_of_the_motion() -> None:
    stream = SetPointStream(LIMITS, AHEAD, 1e-3)
    stream.begin(0 * TWO, 0.0)
    rows, number = [], 0
    for now in np.arange(0.0, 0.6, 1e-3):
        while number * PERIOD <= now:
            stream.put(number * PERIOD, *bang(number * PERIOD))
            number += 1
        rows.append(stream.at(float(now))[0])
    a, j = (np.abs(np.diff(rows, n, axis=0) / 1e-3**n).max() for n in (2, 3))
    assert 9.9 < a <= 10 * 1.03 and j <= 400 * 1.3, "with cubics it would be a jerk of 617"
    assert rows[-1][0] == pytest.approx(bang(1.0)[0][0], abs=1e-12)


def test_ceasing_set_points_lead_to_rest_within_the_limits() -> None:
    q, stream = played(2.0, sent=0.6)
    assert "ceased to come" in stream.ceased
    v, a, j = (np.diff(q, n, axis=0) / 1e-3**n for n in (1, 2, 3))
    assert np.abs(v).max() <= 2.0 and not v[-500:].any()
    assert np.abs(a).max() <= 20 * 1.01 and np.abs(j[100:]).max() <= 400 * 1.05
    ended = float(q[-1, 0])
    stream.put(2.0, *wave(2.0))
    assert stream.at(2.1)[0][0] == ended, "later set-points would start elsewhere"
    stream.begin(q[-1], 2.2)
    stream.put(2.21, q[-1], 0 * TWO)
    assert not stream.ceased and np.allclose(stream.at(2.4)[0], q[-1])


def test_long_rest_is_no_fault() -> None:
    stream = SetPointStream(LIMITS, AHEAD, PERIOD / 2)
    stream.begin(TWO, 0.0)
    assert np.array_equal(stream.at(100.0)[0], TWO) and not stream.ceased
    for n in range(3):
        stream.put(100.0 + n * PERIOD, TWO, 0 * TWO)
    stream.put(100.03, 1.01 * TWO, 0 * TWO)
    assert not stream.ceased
    before = [stream.at(100.02 + AHEAD)[0], stream.at(100.025 + AHEAD)[0]]
    assert np.array_equal(before[0], TWO), "it does not move early"
    assert np.all(before[1] > TWO) and np.all(before[1] < 1.005 * TWO), "it begins with no acceleration"


def test_nearby_rest_is_reached_once() -> None:
    stream, off = SetPointStream(LIMITS, AHEAD, 1e-3), 5e-4
    stream.begin(0 * TWO, 0.0)
    rows, number = [], 0
    for now in np.arange(0.0, 0.3, 1e-3):
        while number * PERIOD <= now:
            stream.put(number * PERIOD, off * TWO, 0 * TWO)
            number += 1
        rows.append(stream.at(float(now))[0])
    v, a, j = (np.diff(rows, n, axis=0) / 1e-3**n for n in (1, 2, 3))
    assert v.min() >= 0.0 and not v[60:].any() and np.allclose(rows[-1], off)
    assert np.abs(a).max() <= 10.0 and np.abs(j).max() <= 400.0


@pytest.mark.parametrize(("q", "dq", "said"), [
    (np.nan, 0.0, "shoulder would jump"), (0.0, np.nan, "the velocity of shoulder is no finite number"),
    (0.0, np.inf, "the velocity of shoulder is no finite number"),
])
def test_not_a_number_is_not_played(q: float, dq: float, said: str) -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(0 * TWO, 0.0)
    for n in range(20):
        numbers = (0.0, 0.0) if n < 10 else (q, dq)
        stream.put(n * PERIOD, numbers[0] * TWO, numbers[1] * TWO)
        assert np.isfinite(stream.at(n * PERIOD)).all()
    assert said in stream.ceased


def swing(time: float) -> tuple[np.ndarray, np.ndarray]:
    """The second joint does twice what the first one does; rest, 1 s of motion at 90 % of a limit, and rest again."""
    u = min(max(time - 0.1, 0.0), 1.0)
    q, dq = u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2
    return q * np.array([0.45, 0.9]), dq * np.array([0.45, 0.9])


SWING = Limits(("shoulder", "elbow"), -3 * TWO, 3 * TWO, 2 * TWO, 6 * TWO, 12 * TWO, 120 * TWO)


def held_up(gaps: dict[float, float], until: float) -> tuple[np.ndarray, np.ndarray, SetPointStream]:
    """What is asked for every 2 ms of a swing, but for gaps [s] at times [s]: times, set-points, stream."""
    stream = SetPointStream(SWING, AHEAD)
    stream.begin(0 * TWO, 0.0)
    times, rows, number, now, left = [], [], 0, 0.0, sorted(gaps.items())
    while now < until:
        while number * PERIOD <= now:
            stream.put(number * PERIOD, *swing(number * PERIOD))
            number += 1
        q, dq = stream.at(now)
        if stream.ceased and not dq.any():
            break  # a controller would start again where the arm is
        times.append(now)
        rows.append(q)
        now += left.pop(0)[1] if left and left[0][0] <= now else 2e-3
    return np.array(times), np.array(rows), stream


def check_limits(times: np.ndarray, q: np.ndarray) -> None:
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
def test_held_up_driver_ramps_up_from_where_it_was(gap: float) -> None:
    times, q, stream = held_up({0.6: gap}, 2.0)
    check_limits(times, q)
    assert not stream.ceased and np.allclose(q[:, 1], 2 * q[:, 0]), "it stays on the path"
    assert np.allclose(q[-1], swing(9.0)[0]) and stream.behind == 0.0
    moving = np.abs(np.diff(q[:, 0])) > 0
    assert moving.sum() * 2e-3 < 1.35, "nor does it take its time"


@pytest.mark.parametrize("seed", range(10))
def test_no_hold_up_makes_a_set_point_exceed_a_limit(seed: int) -> None:
    random = np.random.default_rng(seed)
    gaps = {float(time): float(random.uniform(0.005, 0.2 if seed % 2 else 0.04)) for time in random.uniform(0, 1.2, 8)}
    times, q, stream = held_up(gaps, 4.0)
    check_limits(times, q)
    assert np.allclose(q[:, 1], 2 * q[:, 0], atol=1e-3 if stream.ceased else 1e-9)
    assert stream.ceased or np.allclose(q[-1], swing(9.0)[0])


def test_delay_is_made_up_where_limits_leave_room_and_at_rest() -> None:
    slow = SetPointStream(SWING, AHEAD)
    slow.begin(0 * TWO, 0.0)
    late, number, now = [], 0, 0.0
    while now < 6.0:
        while number * PERIOD <= now:
            q, dq = swing(number * PERIOD / 5)
            slow.put(number * PERIOD, q, dq / 5)
            number += 1
        slow.at(now)
        now += 0.03 if 2.0 <= now < 2.002 else 2e-3
        late.append((now, slow.behind))
    most = max(behind for _, behind in late)
    assert 0.028 < most < 0.1
    assert max(behind for time, behind in late if time > 3.0) <= 2.1e-3, "of the motion that ends at 5.6 s"


def test_repeated_hold_ups_end_the_motion_before_a_stop_would_be_late() -> None:
    times, q, stream = held_up({0.2 + n * 1e-6: 0.08 for n in range(12)}, 4.0)
    check_limits(times, q)
    assert "held up too often: it is 3" in stream.ceased


def test_long_hold_up_leaves_the_arm_where_it_has_stopped() -> None:
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
def test_jump_is_not_played(jump: float) -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(0 * TWO, 0.0)
    stream.put(0.01, 0 * TWO, 0 * TWO)
    stream.put(0.02, np.array([0.0, jump]), 0 * TWO)
    assert "elbow would jump" in stream.ceased
    assert all(not stream.at(t)[0].any() for t in (0.05, 0.1, 1.0))


def test_set_point_older_than_the_newest_is_ignored() -> None:
    stream = SetPointStream(LIMITS, AHEAD)
    stream.begin(0 * TWO, 0.0)
    stream.put(0.02, 0.01 * TWO, 0 * TWO)
    stream.put(0.01, 5 * TWO, 0 * TWO)
    for now in np.arange(0.0, 1.0, 2e-3):
        q, _ = stream.at(float(now))
    assert not stream.ceased and q[0] == pytest.approx(0.01)


@pytest.mark.parametrize("at_rest", [False, True])
def test_set_points_after_a_gap_do_not_move_the_arm(at_rest: bool) -> None:
    stream = SetPointStream(LIMITS, AHEAD, 1e-3)
    stream.begin(0 * TWO, 0.0)
    rows = []
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
    assert np.abs(np.diff(rows, axis=0)).max() / 1e-3 <= LIMITS.velocity[0]
    assert np.abs(rows[-1] - rows[-50]).max() < 1e-3
