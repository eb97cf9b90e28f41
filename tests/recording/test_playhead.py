from hypothesis import given
from hypothesis import strategies as st

from recording.player import Playhead

SECOND = 1_000_000_000


def test_messages_are_due_at_their_recorded_times() -> None:
    head = Playhead(100 * SECOND, 5000 * SECOND)
    assert head.due(102 * SECOND) == 5002 * SECOND
    assert head.position(5003 * SECOND) == 103 * SECOND


def test_rate_scales_the_waits() -> None:
    head = Playhead(0, 0, rate=4)
    assert head.due(8 * SECOND) == 2 * SECOND
    assert head.position(2 * SECOND) == 8 * SECOND


def test_pause_delays_later_messages() -> None:
    head = Playhead(0, 0)
    head.pause(3 * SECOND)
    assert head.paused and head.position(9 * SECOND) == 3 * SECOND
    head.resume(10 * SECOND)
    assert head.due(5 * SECOND) == 12 * SECOND


def test_jump_keeps_the_pause() -> None:
    head = Playhead(0, 0, paused=True)
    head.jump(7 * SECOND, 20 * SECOND)
    assert head.paused and head.position(30 * SECOND) == 7 * SECOND
    head.resume(40 * SECOND)
    assert head.due(8 * SECOND) == 41 * SECOND


@given(st.integers(0, 10**15), st.integers(0, 10**15), st.floats(0.01, 1000), st.integers(0, 10**12))
def test_position_and_due_time_are_inverse(start: int, now: int, rate: float, later: int) -> None:
    head = Playhead(start, now, rate=rate)
    assert abs(head.position(head.due(start + later)) - (start + later)) <= rate + 1
