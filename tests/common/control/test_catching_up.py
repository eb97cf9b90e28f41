"""A goal with a time to start catches up after late cycles, and nothing is faster than the limits, by differences."""

from __future__ import annotations

import numpy as np
import pytest

from common.control.limiter import SLACK
from common.control.trajectory_controller import PERIOD, TrajectoryController
from tests.common.control.trajectories import LIMITS, rest_to_rest

START_AT, GAP = 100.1, 0.06  # [s] cell time
FASTEST = 1.15 * 1.875 * 2.0 / LIMITS.velocity[0]  # [s] of 2 rad: at the speed limit with a reserve of 15 %


def sent(duration: float, start_at: float) -> tuple[list[float], np.ndarray]:
    """Return cell times [s] and set-points [rad] of a motion with one late cycle, to its end."""
    q, now = np.zeros(2), 100.0
    controller = TrajectoryController(LIMITS, q)
    controller.update(now, q, 0 * q)
    way = rest_to_rest(q, [2.0, -1.0], duration, 101)
    assert controller.accept("a", way, now, q, start_at=start_at).state == "active"
    times, found, dq = [now], [q], 0 * q
    while controller.status.state == "active":
        late = 100.3 < now <= 100.3 + PERIOD
        now += GAP if late else PERIOD
        q, dq = controller.update(now, q, dq)
        times.append(now)
        found.append(q)
    assert controller.status.state == "succeeded"
    return times, np.array(found)


@pytest.mark.parametrize(("duration", "start_at", "least", "most"), [
    (FASTEST, START_AT, -PERIOD, PERIOD),  # on time again
    (FASTEST / 1.15, START_AT, 0.02, 0.5),  # no reserve: it stays late
    (2 * FASTEST, 0.0, 0.02, 0.5),  # without a time to start nothing is late
])
def test_late_goal_catches_up_within_the_limits(duration: float, start_at: float, least: float, most: float) -> None:
    times, q = sent(duration, start_at)
    v = np.diff(q, axis=0) / np.diff(times)[:, None]
    assert (np.abs(v) <= LIMITS.velocity * (1 + 1e-6)).all()
    a = np.diff(v, axis=0) / PERIOD
    gap = int(np.argmax(np.diff(times)))  # the arm comes to rest by itself in it
    hard = np.delete(a, [gap - 1, gap], axis=0)
    assert (np.abs(hard) <= LIMITS.acceleration * (1 + SLACK)).all()
    passed = 2.0 * (10 * 0.9**3 - 15 * 0.9**4 + 6 * 0.9**5)  # [rad] at 90 % of its time
    lag = float(np.interp(passed, q[:, 0], times)) - (start_at or 100.0) - 0.9 * duration
    assert least <= lag <= most


def test_late_cycles_before_the_start_do_not_delay_it() -> None:
    q, now = np.zeros(2), 100.0
    controller = TrajectoryController(LIMITS, q)
    controller.update(now, q, 0 * q)
    controller.accept("a", rest_to_rest(q, [2.0, -1.0], FASTEST / 1.15, 101), now, q, start_at=100.5)
    for gap in [0.15, 0.02, 0.15, 0.15, *[PERIOD] * 10]:
        now += gap
        q, dq = controller.update(now, q, 0 * q)
        assert now > 100.5 or not dq.any(), "it starts too early"
    assert now - 100.5 - controller.status.path_time == pytest.approx(0.0, abs=2 * PERIOD)
