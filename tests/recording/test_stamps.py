import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.messages import Header, Image, LogLine, Pose, TFMessage, TransformStamped
from recording.sample import restamp, stamp_of
from tests.recording.samples import packed

TF = TFMessage(transforms=[
    TransformStamped(header=Header(stamp=stamp, frame_id="world"), child_frame_id=child, transform=Pose())
    for stamp, child in ((5, "a"), (6, "b"))])


def later(stamp):
    return stamp + 100


def test_stamp_is_that_of_the_header_or_of_the_first_transform():
    image = Image(header=Header(stamp=123, frame_id="c"), height=480, width=640, encoding="bgr8", data=bytes(921600))
    assert stamp_of(packed(image)) == stamp_of(packed(image)[:600]) == 123, "without the pixels"
    assert stamp_of(packed(TF)) == 5


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"hello", msgpack.packb({"a": 1}), msgpack.packb({"header": 3}),
                                     msgpack.packb({"transforms": []}), msgpack.packb([1, 2])])
def test_payload_without_a_header_has_no_stamp_and_stays_unchanged(payload):
    assert stamp_of(payload) is None
    assert restamp(payload, later) == payload


@pytest.mark.parametrize("stamp", [-1, 2**63, 2**64 - 1, "7", 1.0])
def test_stamp_out_of_range_is_ignored(stamp):  # a file has no room for it either
    assert stamp_of(msgpack.packb({"header": {"stamp": stamp}})) is None


@given(st.binary(max_size=700))
def test_random_bytes_never_raise(payload):
    assert stamp_of(payload) is None or restamp(payload, later)
    restamp(payload, later)


def test_restamping_changes_every_stamp_but_zero_and_nothing_else():
    moved = TFMessage.model_validate(msgpack.unpackb(restamp(packed(TF), later)))
    assert [t.header.stamp for t in moved.transforms] == [105, 106]
    assert moved.transforms[0].transform == TF.transforms[0].transform
    line = packed(LogLine(service="s", level="info", message="m"))
    assert restamp(line, later) == line
