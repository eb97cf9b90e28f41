"""Simulated fingers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import GripperConfig
from common.hardware.mock import SimulatedFingers

CONFIG = GripperConfig(joints=["left", "right"], links=[])
WIDTHS = st.floats(0.0, 0.08)


@pytest.fixture
def fingers() -> SimulatedFingers:
    return SimulatedFingers(CONFIG, 0.08)


@pytest.fixture
def holding(fingers: SimulatedFingers) -> SimulatedFingers:
    """Fingers that hold an object of 6 cm at 2 s."""
    fingers.command(0.0, 0.0)
    fingers.obstruct(0.06)
    assert fingers.read(2.0).holding
    return fingers


def test_fingers_close_smoothly_and_stop_at_the_width(fingers: SimulatedFingers) -> None:
    fingers.command(0.08, 9.0)
    assert not fingers.read(9.0).moving, "they are there already"
    fingers.command(0.02, 10.0)
    widths = [fingers.read(float(t)).width for t in np.arange(10.0, 12.0, 0.005)]
    assert widths == sorted(widths, reverse=True) and widths[-1] == 0.02
    assert np.max(np.abs(np.diff(widths))) <= CONFIG.speed * 0.005 + 1e-9
    reading = fingers.read(12.0)
    assert not reading.moving and not reading.holding and reading.velocity == 0.0


@given(st.lists(st.tuples(WIDTHS, st.floats(0.0, 0.5)), min_size=1, max_size=6))
def test_commands_during_a_motion_keep_limits_and_the_last_is_reached(commands: list[tuple[float, float]]) -> None:
    fingers, now, before = SimulatedFingers(CONFIG, 0.08), 0.0, 0.08
    for width, wait in [*commands, (commands[-1][0], 2.0)]:
        fingers.command(width, now)
        for _ in range(int(wait / 0.01)):
            now += 0.01
            reading = fingers.read(now)
            assert 0.0 <= reading.width <= CONFIG.max_width
            assert abs(reading.width - before) <= CONFIG.speed * 0.01 * 1.01 + 1e-9
            before = reading.width
    assert before == pytest.approx(commands[-1][0], abs=1e-9) and not fingers.read(now).moving


@given(obstruction=st.floats(0.01, 0.07), step=st.floats(0.002, 0.3))
def test_fingers_stop_at_an_object_and_hold_it(obstruction: float, step: float) -> None:
    fingers = SimulatedFingers(CONFIG, 0.08)
    fingers.command(0.0, 0.0)
    fingers.obstruct(obstruction)
    assert min(fingers.read(float(t)).width for t in np.arange(0.0, 2.0, step)) >= obstruction
    reading = fingers.read(2.5)
    assert reading.width == obstruction and reading.holding and not reading.moving


def test_fingers_that_lose_their_object_continue_to_close(holding: SimulatedFingers) -> None:
    holding.obstruct(0.0)
    assert holding.read(2.01).moving and not holding.read(2.01).holding and holding.read(4.0).width == 0.0


def test_second_close_command_continues_the_hold_and_opening_releases(holding: SimulatedFingers) -> None:
    holding.command(0.01, 2.0)
    assert holding.read(2.0).holding and holding.read(2.0).width == 0.06
    holding.command(0.08, 2.0)
    assert not holding.read(2.0).holding and holding.read(4.0).width == 0.08


@given(WIDTHS, WIDTHS)
def test_fingers_are_never_faster_than_their_least_time(start: float, end: float) -> None:
    fingers, way = SimulatedFingers(CONFIG, start), abs(end - start)
    fingers.command(end, 0.0)
    for share in (0.25, 0.5, 0.75, 1.0):
        assert abs(fingers.read(CONFIG.least_time(share * way)).width - start) <= share * way + 1e-9
    assert abs(fingers.read(CONFIG.least_time(way) + 0.2).width - end) < 1e-9, "and not much slower"
