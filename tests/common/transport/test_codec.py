import struct

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common import messages as m
from common.errors import DecodeError
from common.transport.codec import (
    Attachment,
    decode,
    decode_attachment,
    decode_error,
    encode,
    encode_attachment,
    encode_error,
    encoding_of,
)

finite = st.floats(-1e7, 1e7)
names = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), max_size=10)
vectors = st.builds(m.Vector3, x=finite, y=finite, z=finite)
images = st.builds(
    m.Image, header=st.builds(m.Header, stamp=st.integers(0, 2**63 - 1), frame_id=names),
    height=st.integers(1, 100), width=st.integers(1, 100), encoding=names, data=st.binary(max_size=200),
)


@given(st.one_of(vectors, images))
def test_message_survives_encoding(message: m.Message) -> None:
    assert decode(type(message), encode(message)) == message


def test_kind_of_a_goal_survives_encoding() -> None:
    for goal in (m.JointGoal(positions=[0.1]), m.PoseGoal(pose=m.Pose())):
        request = m.PlanRequest(id="a", goal=goal, allowed_collisions=[("a", "b")])
        assert decode(m.PlanRequest, encode(request)) == request


@given(st.binary(max_size=300))
def test_any_bytes_give_a_message_or_one_clear_line(payload: bytes) -> None:
    try:
        decode(m.PoseArray, payload)
    except DecodeError as error:
        assert str(error).startswith("PoseArray")
        assert "\n" not in str(error)


@given(images, st.data())
def test_truncated_payload_is_refused(image: m.Image, data: st.DataObject) -> None:
    payload = encode(image)
    with pytest.raises(DecodeError):
        decode(m.Image, payload[: data.draw(st.integers(0, len(payload) - 1))])


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "payload is empty"),
        (b"\xc1", "not msgpack"),
        (encode(m.Vector3()) + b"\x00", "1 bytes after the end"),
        (msgpack.packb([1, 2]), "payload is a list of 2, not a map"),
        (msgpack.packb({"x": float("nan")}), "Vector3.x: must be a finite number, not nan"),
        (msgpack.packb({"x": "wide"}), "Vector3.x: must be a valid number"),
        (msgpack.packb({"q": 1}), "Vector3.q: Extra inputs are not permitted"),
        (msgpack.packb({1: 1}), "not msgpack"),
        (b"\xdd" + struct.pack(">I", 2**32 - 1), "not msgpack"),
        (b"\x91" * 5000, "not msgpack"),
    ],
)
def test_bad_payload_is_refused_with_the_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(DecodeError, match=reason):
        decode(m.Vector3, payload)


def test_payload_over_the_limit_is_refused_before_it_is_parsed() -> None:
    with pytest.raises(DecodeError, match="payload has 101 bytes, the limit is 100"):
        decode(m.Vector3, bytes(101), limit=100)


def test_error_names_the_field_within_the_message() -> None:
    payload = encode(m.PoseArray(poses=[m.Pose()]))
    value = msgpack.unpackb(payload)
    value["poses"][0]["position"]["y"] = float("inf")
    with pytest.raises(DecodeError, match=r"PoseArray\.poses\.0\.position\.y: must be a finite number, not inf"):
        decode(m.PoseArray, msgpack.packb(value))


@given(names, st.integers(0, 2**60), names, st.none() | st.integers(0, 2**32 - 1))
def test_attachment_survives_encoding(writer: str, sequence: int, trace: str, checksum: int | None) -> None:
    attachment = Attachment(writer, sequence, trace=trace, checksum=checksum)
    assert decode_attachment(encode_attachment(attachment)) == attachment


def test_missing_attachment_is_allowed() -> None:
    assert decode_attachment(None) is None
    assert decode_attachment(b"") is None


@pytest.mark.parametrize(
    "data", [b"\xc1", msgpack.packb([1, 2]), msgpack.packb(["a", 1, 99, ""]), msgpack.packb(["a", 1, 1, "", "sum"]),
             msgpack.packb(["a", -1, 1, ""]), msgpack.packb(["a", 2**64 - 1, 1, ""]), msgpack.packb({"a": 1}),
             msgpack.packb(["\x1b[2J", 1, 1, ""])]
)
def test_foreign_attachment_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError, match="attachment"):
        decode_attachment(data)


def test_error_reply_survives_encoding_and_differs_from_one_of_zenoh() -> None:
    assert decode_error(encode_error("code", "what went wrong")) == ("code", "what went wrong")
    assert decode_error(b"Timeout") is None


def test_encoding_names_the_message() -> None:
    assert encoding_of(m.Image) == "application/msgpack;Image"
