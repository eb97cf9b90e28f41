from hypothesis import given
from hypothesis import strategies as st

from common.supervision.child import Backoff


def test_delay_doubles_up_to_the_cap() -> None:
    backoff = Backoff()
    assert [backoff.after(1.0) for _ in range(8)] == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]


def test_a_long_life_starts_over() -> None:
    backoff = Backoff()
    for _ in range(5):
        backoff.after(0.0)
    assert backoff.after(10.0) == 0.1
    assert backoff.after(9.9) == 0.2


@given(st.lists(st.floats(min_value=0, max_value=100)))
def test_delay_is_never_out_of_bounds(lives: list[float]) -> None:
    backoff = Backoff()
    assert all(0.1 <= backoff.after(life) <= 5.0 for life in lives)
