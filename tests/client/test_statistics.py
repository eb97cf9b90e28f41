import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.client.statistics import COVERED, Arrivals, describe


@given(st.floats(0.5, 200), st.integers(1, 10**6))
def test_even_arrivals_have_their_rate(rate: float, size: int) -> None:
    arrivals = Arrivals()
    count = int(rate * 4) + 2
    for index in range(count):
        arrivals.add(index / rate, size)
    figures = arrivals.figures(0.0)
    assert figures["hz"] == pytest.approx(rate, rel=1e-3, abs=1e-3)
    assert figures["bytes_per_second"] == pytest.approx(rate * size, rel=1e-3, abs=0.1)
    assert figures["messages"] == count


def test_what_came_long_ago_is_forgotten() -> None:
    arrivals = Arrivals()
    for when in (0.0, 0.1, 0.2):
        arrivals.add(when, 10)
    assert arrivals.figures(COVERED + 1)["hz"] == 0.0


def test_lines_for_people() -> None:
    arrivals = Arrivals()
    assert describe(arrivals.figures(0.0), in_bytes=False) == "nothing came yet"
    arrivals.add(0.0, 1000)
    assert describe(arrivals.figures(0.0), in_bytes=True) == "1 messages, too few for a rate"
    arrivals.add(0.1, 1000)
    assert describe(arrivals.figures(0.1), in_bytes=False) == "10.00 Hz, 100.0 to 100.0 ms apart, 2 messages"
    assert describe(arrivals.figures(0.1), in_bytes=True) == "0.010 MB/s, 1000 B each, 10.00 Hz"
