"""Set-points as the controller of Universal Robots reads them, on its own clock, from a driver that wakes up late."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import drivers.ur
from common.hardware.streaming import SetPointStream
from tests.common.hardware.test_streaming import bang
from tests.drivers.test_ur_driver import LIMITS, SIX, Controller, arm, controller

__all__ = ["arm", "controller"]
PERIOD, LATENCY, PHASE = 0.002, 3e-4, 1.3e-3  # [s]


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4], ids="{:+} of the clock".format)
@pytest.mark.parametrize("late", [0.0, 8e-4], ids="up to {} s late".format)
def test_set_points_are_those_of_the_controllers_cycles(controller: Controller, arm, monkeypatch, late, drift) -> None:
    random, clock, sent = np.random.default_rng(1), SimpleNamespace(now=50.0), list[tuple[float, float]]()

    def sleep(seconds: float) -> None:
        clock.now += seconds + random.uniform(0, late)

    def cycle(now: float) -> float:
        return (now - 50.0 - PHASE) / PERIOD * (1 + drift)

    monkeypatch.setattr(drivers.ur, "time", SimpleNamespace(monotonic=lambda: clock.now, sleep=sleep))
    controller.getTimestamp = lambda: math.floor(cycle(clock.now - LATENCY)) * PERIOD  # type: ignore[method-assign]
    controller.servoJ = lambda q, *_: sent.append((cycle(clock.now), q[0])) or True  # type: ignore[attr-defined]
    stream, number = SetPointStream(LIMITS, 0.05, PERIOD), 0
    stream.begin(0 * SIX, clock.now)
    while clock.now < 53.0:
        while 50.0 + 0.01 * number <= clock.now:
            q, dq = bang(0.01 * number - 2.0)
            stream.put(50.0 + 0.01 * number, np.tile(q, 3), np.tile(dq, 3))
            number += 1
        arm.read()
        for at in arm.due():
            arm.servo([stream.at(at)[0]])
        sleep(2e-4)
    times, q = np.array(sent).T
    read = q[np.searchsorted(times, np.arange(300, int(times[-1]))) - 1]
    assert read[-1] == pytest.approx(bang(1.0)[0][0])
    assert np.abs(np.diff(read, 2)).max() / PERIOD**2 <= 10 * 1.05, "accelerations between two cycles"
    assert np.abs(np.diff(read, 3)).max() / PERIOD**3 <= 400 * 1.5
