"""How late an arm will be for an object in motion."""

import math

import pytest

from common.messages import Header, MotionStatus
from common.tasks.tracking import CAUGHT_UP, Expected


@pytest.mark.parametrize(("now", "path_time", "lag"), [
    (100.5, -0.5, 0.0),  # it waits for its start at 101
    (102.0, 1.0, 0.0),
    (102.0, 0.8, 0.2 - CAUGHT_UP * 1.2),  # it catches up before the fingers close, 2 s after its start
    (103.0, 1.9, 0.1 - CAUGHT_UP * 0.1),
    (103.5, 2.3, 0.2),
])
def test_lag_counts_what_the_arm_does_not_catch_up(now: float, path_time: float, lag: float) -> None:
    expected = Expected("belt", 100.0, 0.0, 0.1, begins=101.0, closes=103.0)
    status = MotionStatus(header=Header(stamp=round(now * 1e9)), path_time=path_time)
    assert max(expected.lag(status), 0.0) == pytest.approx(max(lag, 0.0))
    assert Expected("belt", 100.0, 0.0, 0.1, begins=101.0).lag(status) == -math.inf
