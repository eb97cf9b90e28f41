import contextlib
import struct

import msgpack
import pytest

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
from tests.mutations import Mutations, models, real

MUTATIONS = 60  # of each message, and of each side; `make fuzz` tries many more
HEADER = m.Header(stamp=2**63 - 1, frame_id="kamera ü")
IMAGE = m.Image(header=HEADER, height=1, width=2, encoding="bgr8", data=bytes(6))


def test_kind_of_a_goal_survives_encoding() -> None:
    for goal in (m.JointGoal(positions=[0.1]), m.PoseGoal(pose=m.Pose())):
        request = m.PlanRequest(id="a", goal=goal, allowed_collisions=[("a", "b")])
        assert decode(m.PlanRequest, encode(request)) == request


def test_truncated_payload_is_refused() -> None:
    payload = encode(IMAGE)
    assert decode(m.Image, payload) == IMAGE
    for size in range(len(payload)):
        with pytest.raises(DecodeError):
            decode(m.Image, payload[:size])


@pytest.mark.parametrize(("payload", "reason"), [
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
])
def test_bad_payload_is_refused_with_the_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(DecodeError, match=reason):
        decode(m.Vector3, payload)


def test_payload_over_the_limit_is_refused_before_it_is_parsed() -> None:
    with pytest.raises(DecodeError, match="payload has 101 bytes, the limit is 100"):
        decode(m.Vector3, bytes(101), limit=100)


def test_error_names_the_field_within_the_message() -> None:
    value = msgpack.unpackb(encode(m.PoseArray(poses=[m.Pose()])))
    value["poses"][0]["position"]["y"] = float("inf")
    with pytest.raises(DecodeError, match=r"PoseArray\.poses\.0\.position\.y: must be a finite number, not inf"):
        decode(m.PoseArray, msgpack.packb(value))


def test_changed_payloads_give_messages_or_one_clear_line() -> None:
    mutations = Mutations(seed=1)
    refused = read = 0
    for model in models():
        for value in real(model):
            assert model.model_validate(value).model_dump() == value, "mutations start from valid messages"
        for _ in range(MUTATIONS):
            payload = mutations.payload(model)
            decode_error(payload)
            with contextlib.suppress(DecodeError):
                decode_attachment(payload)
            try:
                message = decode(model, payload)
            except DecodeError as error:
                refused += 1
                assert "\n" not in str(error) and len(str(error)) < 1000
            else:
                read += 1
                assert decode(model, encode(message)) == message
    assert refused > read > 100


@pytest.mark.parametrize("attachment", [
    Attachment("", 0, trace=""), Attachment("arm ü.1", 2**60, trace="7f", checksum=2**32 - 1),
    Attachment("arm", 1, trace="", checksum=0),
])
def test_attachment_survives_encoding(attachment: Attachment) -> None:
    assert decode_attachment(encode_attachment(attachment)) == attachment


@pytest.mark.parametrize("data", [
    b"\xc1", *(msgpack.packb(value) for value in (
        [1, 2], ["a", 1, 99, ""], ["a", 1, 1, "", "sum"], ["a", -1, 1, ""], ["a", 2**64 - 1, 1, ""], {"a": 1},
        ["\x1b[2J", 1, 1, ""])),
])
def test_foreign_attachment_is_refused_and_a_missing_one_allowed(data: bytes) -> None:
    with pytest.raises(DecodeError, match="attachment"):
        decode_attachment(data)
    assert decode_attachment(None) is decode_attachment(b"") is None


def test_error_reply_survives_encoding_and_differs_from_one_of_zenoh() -> None:
    assert decode_error(encode_error("code", "what went wrong")) == ("code", "what went wrong")
    assert decode_error(b"Timeout") is None


def test_encoding_names_the_message() -> None:
    assert encoding_of(m.Image) == "application/msgpack;Image"


@pytest.mark.parametrize(("message", "left_out"), [
    (m.HoldRequest(hold=True), {"goal"}),
    (m.HoldRequest(hold=True, goal="a"), set()),
    (m.GripperCommand(id="a", width=0.01), set(m.GripperCommand.omitted_defaults)),
    (m.GripperCommand(id="a", width=0.01, owner="ann"), {*m.GripperCommand.omitted_defaults} - {"owner"}),
])
def test_fields_that_earlier_readers_do_not_know_are_sent_only_with_another_value_than_their_default(message, left_out):
    sent = msgpack.unpackb(encode(message))
    assert set(type(message).model_fields) - set(sent) == left_out
    assert decode(type(message), encode(message)) == message
