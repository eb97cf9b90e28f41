"""Statistics of messages: rate, size, delay, and the stamp in a payload."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.client.statistics import KINDS, WINDOW, Arrivals, Delays, stamp_of
from common.messages import Header, Image, JointState, Pose, TFMessage, TransformStamped
from common.transport.codec import encode

STAMP = 1_763_737_000_123_456_789


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
    assert arrivals.figures(count / rate + WINDOW + 1)["hz"] == 0.0, "arrivals outside the window do not count"


def test_figures_as_text() -> None:
    arrivals = Arrivals()
    assert KINDS["hz"](arrivals.figures(0.0)) == "no message received yet"
    arrivals.add(0.0, 1000)
    assert KINDS["bw"](arrivals.figures(0.0)) == "1 messages, too few for a rate"
    arrivals.add(0.1, 1000)
    assert KINDS["hz"](arrivals.figures(0.1)) == "10.00 Hz, 100.0 to 100.0 ms apart, 2 messages"
    assert KINDS["bw"](arrivals.figures(0.1)) == "0.010 MB/s, 1000 B each, 10.00 Hz"


@pytest.mark.parametrize("payload", [
    encode(JointState(header=Header(stamp=STAMP), name=["a"], position=[0.0])),
    encode(Image(header=Header(stamp=STAMP, frame_id="x" * 120), height=60, width=80, encoding="mono8",
                 data=bytes(4800))),
    encode(TFMessage(transforms=[
        TransformStamped(header=Header(stamp=stamp, frame_id="a"), child_frame_id="b", transform=Pose())
        for stamp in (STAMP, 5)])),
    msgpack.packb({"data": bytes(10_000), "header": {"stamp": STAMP}}),
], ids=["joints", "image", "tf", "header at the end"])
def test_stamp_is_read_without_unpacking_the_rest(payload: bytes) -> None:
    assert stamp_of(payload) == STAMP


@pytest.mark.parametrize("value", [
    {"a": 1}, {}, [1, 2], 7, "text", {"header": 3}, {"header": {}}, {"header": {"stamp": "now"}},
    {"header": {"stamp": 0}}, {"transforms": []},
])
def test_message_without_stamp_has_none(value: object) -> None:
    assert stamp_of(msgpack.packb(value)) is None


@given(st.binary(max_size=600))
def test_garbage_has_no_stamp(data: bytes) -> None:
    assert stamp_of(data) is None or isinstance(stamp_of(data), int)


def delays_of(delays: list[float]) -> Delays:
    window = Delays()
    for delay in delays:
        window.add(0.0, delay)
    return window


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=50))
def test_figures_lie_within_the_delays(delays: list[float]) -> None:
    figures = delays_of(delays).figures(0.0)
    low, mean, middle, p99, high = (float(figures[name] or 0) for name in ("min", "mean", "p50", "p99", "max"))
    assert low <= middle <= p99 <= high
    assert low - 1e-3 <= mean <= high + 1e-3
    assert (low, high) == pytest.approx((min(delays), max(delays)), abs=1e-3)


def test_median_and_tail_are_interpolated_and_delays_outside_the_window_count_only_in_the_total() -> None:
    window = delays_of([float(delay) for delay in range(101)])
    figures = window.figures(0.0)
    assert (figures["p50"], figures["p99"], figures["mean"]) == (50.0, 99.0, 50.0)
    figures = window.figures(WINDOW + 1)
    assert figures["mean"] is None and figures["messages"] == 101
