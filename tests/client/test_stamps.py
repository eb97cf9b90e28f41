import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.client.statistics import COVERED, Delays, stamp_of
from common.messages import Header, Image, JointState, Pose, TFMessage, TransformStamped
from common.transport.codec import encode

STAMP = 1_763_737_000_123_456_789


def transforms(*stamps: int) -> TFMessage:
    return TFMessage(transforms=[
        TransformStamped(header=Header(stamp=stamp, frame_id="a"), child_frame_id="b", transform=Pose())
        for stamp in stamps
    ])


@pytest.mark.parametrize("message", [
    JointState(header=Header(stamp=STAMP), name=["a"], position=[0.0]),
    Image(header=Header(stamp=STAMP, frame_id="x" * 120), height=60, width=80, encoding="mono8", data=bytes(4800)),
    transforms(STAMP, 5),
])
def test_stamp_is_read_without_the_rest(message: JointState | Image | TFMessage) -> None:
    assert stamp_of(encode(message)) == STAMP


def test_header_after_something_large_is_found_too() -> None:
    assert stamp_of(msgpack.packb({"data": bytes(10_000), "header": {"stamp": STAMP}})) == STAMP


@pytest.mark.parametrize("value", [
    {"a": 1}, {}, [1, 2], 7, "text", {"header": 3}, {"header": {}}, {"header": {"stamp": "now"}},
    {"header": {"stamp": 0}}, {"transforms": []},
])
def test_what_has_no_stamp_has_none(value: object) -> None:
    assert stamp_of(msgpack.packb(value)) is None


@given(st.binary(max_size=600))
def test_garbage_has_no_stamp(data: bytes) -> None:
    assert stamp_of(data) is None or isinstance(stamp_of(data), int)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=50))
def test_figures_lie_within_what_came(delays: list[float]) -> None:
    heard = Delays()
    for delay in delays:
        heard.add(0.0, delay)
    figures = heard.figures(0.0)
    low, mean, middle, p99, high = (float(figures[name] or 0) for name in ("min", "mean", "p50", "p99", "max"))
    assert low <= middle <= p99 <= high
    assert low - 1e-3 <= mean <= high + 1e-3
    assert (low, high) == pytest.approx((min(delays), max(delays)), abs=1e-3)


def test_median_and_tail_are_interpolated() -> None:
    heard = Delays()
    for delay in range(101):
        heard.add(0.0, float(delay))
    figures = heard.figures(0.0)
    assert (figures["p50"], figures["p99"], figures["mean"]) == (50.0, 99.0, 50.0)


def test_what_came_long_ago_is_forgotten_but_counted() -> None:
    heard = Delays()
    heard.add(0.0, 5.0)
    figures = heard.figures(COVERED + 1)
    assert figures["mean"] is None
    assert figures["messages"] == 1
