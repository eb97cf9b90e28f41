"""Jerk of executed motions, by differences from cycle to cycle: of stops, holds and changes of speed on the way."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import ruckig

from common.control.limiter import SLACK
from common.control.trajectory_controller import PERIOD, TrajectoryController
from common.hardware.interface import Limits
from common.hardware.streaming import SetPointStream
from common.messages import JointTrajectory
from drivers.ur import Smoothing
from tests.common.control.trajectories import trajectory

DOF = 6
LIMITS = Limits(  # of an arm that its jerk limits most
    tuple(f"j{n}" for n in range(DOF)), np.full(DOF, -6.0), np.full(DOF, 6.0), np.full(DOF, 3.0), np.full(DOF, 5.0),
    np.full(DOF, 10.0), np.full(DOF, 500.0))
SEEDS = pytest.mark.parametrize(
    "seeds", [range(20, 22), pytest.param(range(22, 40), marks=pytest.mark.campaign)], ids=["two", "many"])


def fastest_motion(rng: np.random.Generator) -> JointTrajectory:
    """Move between two random positions as fast as the limits allow."""
    given, way = ruckig.InputParameter(DOF), ruckig.Trajectory(DOF)
    given.current_position, given.target_position = rng.uniform(-2, 2, DOF).tolist(), rng.uniform(-2, 2, DOF).tolist()
    given.max_velocity, given.max_acceleration = LIMITS.velocity.tolist(), LIMITS.acceleration.tolist()
    given.max_jerk = LIMITS.jerks.tolist()
    ruckig.Ruckig(DOF).calculate(given, way)
    times = [*np.arange(0.0, way.duration - PERIOD / 2, PERIOD), way.duration]
    return trajectory(((time, *way.at_time(time)) for time in times), LIMITS.names)


@cache
def executed(event: str, seed: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return times [s] and set-points [rad], [rad/s] of a motion with an event in its middle, until its end."""
    rng = np.random.default_rng(seed)
    planned = fastest_motion(rng)
    q = np.array(planned.points[0].positions)
    controller, now, dq, sent = TrajectoryController(LIMITS, q), 100.0, 0 * q, [(100.0, q, 0 * q)]
    controller.update(now, q, dq)
    assert controller.accept("a", planned, now, q).state == "active"
    at = rng.integers(10, int(0.9 * planned.points[-1].time_from_start / PERIOD))
    for cycle in range(400):
        now += PERIOD
        if cycle == at and event == "stop":
            controller.cancel("a", "enough", now)
        elif cycle == at and event in ("hold", "held"):
            controller.hold(True, "wait")
        elif cycle == at + 50 and event == "held":
            controller.hold(False, "go on")
        elif cycle in (at, at + 50) and event == "speed":
            controller.reports.speed_scaling = 0.3 if cycle == at else 1.0
        set_point = controller.update(now, q, dq)
        assert set_point is not None
        q, dq = set_point
        sent.append((now, q, dq))
    assert controller.at_rest
    return sent


@SEEDS
@pytest.mark.parametrize(("event", "over"), [("stop", SLACK), ("hold", SLACK), ("held", 0.2), ("speed", 0.2)])
def test_jerk_limits_hold_in_a_stop_and_nearly_while_the_speed_rises(event: str, over: float, seeds: range) -> None:
    for seed in seeds:
        sent = [q for _, q, _ in executed(event, seed)]
        jerk = np.abs(np.diff([sent[0]] * 3 + sent, n=3, axis=0)) / PERIOD**3
        assert jerk.max() <= LIMITS.jerks[0] * (1 + over), (seed, jerk.max())


@SEEDS
@pytest.mark.parametrize("rate", [500.0, 125.0])
@pytest.mark.parametrize("event", ["stop", "hold", "held", "speed"])
def test_driver_at_the_arms_rate_adds_little_jerk_to_that_of_the_cycles(event: str, rate: float, seeds: range) -> None:
    period, most = 1 / rate, {"raw": 0.0, "smoothed": 0.0}
    for seed in seeds:
        stream, smoothing, raw = SetPointStream(LIMITS, 0.05, period), Smoothing(1 / period), []
        (begin, start, _), *sent = executed(event, seed)
        stream.begin(start, begin)
        for tick in range(int(4.2 / period)):
            now = begin + (tick + 0.5) * period
            while sent and sent[0][0] <= now:
                stream.put(*sent.pop(0))
            raw.append(stream.at(now)[0])
        assert not stream.ceased
        for name, rows in (("raw", raw), ("smoothed", [smoothing.add(q) for q in raw])):
            jerk = np.abs(np.diff([start] * 3 + rows, n=3, axis=0)).max() / period**3
            most[name] = max(most[name], jerk / LIMITS.jerks[0])
    assert most["smoothed"] <= 1.1 and most["smoothed"] < most["raw"], most
    assert rate < 500 or most["raw"] > 2, most
