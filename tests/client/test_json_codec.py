import json

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common import topics
from common.application import all_topics
from common.client.json_codec import decode, encode
from common.errors import ConfigError
from common.messages import Header, Image, JointState, StopRequest
from common.transport.codec import decode as decode_message
from common.transport.codec import encode as encode_message


def test_image_is_one_line() -> None:
    image = Image(header=Header(stamp=1_500_000_000_250_000_000, frame_id="c"), height=480, width=640, encoding="bgr8",
                  data=bytes(921600))
    assert decode("panda/camera/image_raw", encode_message(image)) == (
        "Image 640x480 bgr8 921600 B stamp 1500000000.250 c"
    )


def test_message_is_shown_as_json() -> None:
    state = JointState(header=Header(stamp=5), name=["a", "b"], position=[0.5, -1.0])
    assert json.loads(decode("panda/joint_states", encode_message(state))) == state.model_dump()


@given(st.binary(max_size=200))
def test_garbage_is_one_line_and_never_an_exception(data: bytes) -> None:
    text = decode("panda/tf", data)
    assert text
    assert "\n" not in text


LEAVES = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary()


@given(st.recursive(LEAVES, lambda some: st.lists(some) | st.dictionaries(st.text(), some), max_leaves=10))
def test_any_msgpack_is_one_line_and_a_map_is_json(value: object) -> None:
    text = decode("other/key", msgpack.packb(value))
    assert "\n" not in text
    if isinstance(value, dict) and not {"height", "width", "encoding", "data"} <= value.keys():
        json.loads(text)


def test_bytes_are_named_and_not_dumped() -> None:
    assert decode("a/b", msgpack.packb({"blob": bytes(1000)})) == '{"blob": "<1000 bytes>"}'


def test_payload_that_is_not_a_map_is_reported() -> None:
    assert decode("a/b", b"A") == "<not a message: int 65>"
    assert decode("a/b", b"") == "<empty payload>"
    assert decode("a/b", b"\xc1 no") == "<not msgpack: 4 bytes c1206e6f: " + decode("a/b", b"\xc1 no").split(": ", 2)[2]


def test_encoding_checks_the_message_of_the_key() -> None:
    payload = encode("panda/motion/stop?x=1", '{"reason": "lunch"}')
    assert decode_message(StopRequest, payload) == StopRequest(reason="lunch")
    wanted = r"motion/stop\.raeson: 'lunch' is not a parameter; choices: by, id, owner, reason"
    with pytest.raises(ConfigError, match=wanted):
        encode("panda/motion/stop", '{"raeson": "lunch"}')
    with pytest.raises(ConfigError, match="is not JSON"):
        encode("panda/motion/stop", "lunch")
    with pytest.raises(ConfigError, match="must be a JSON object"):
        encode("panda/motion/stop", "3")


def test_unknown_key_takes_any_json() -> None:
    assert msgpack.unpackb(encode("other/key", '{"a": {"base64": "AAE="}}')) == {"a": b"\x00\x01"}
    with pytest.raises(ConfigError, match="cannot be sent"):
        encode("other/key", "1" + 30 * "0")
    with pytest.raises(ConfigError, match="is not JSON"):
        encode("other/key", 100_000 * "[")


@pytest.mark.parametrize("topic", all_topics().values(), ids=str)
def test_every_topic_can_be_described(topic: topics.AnyTopic) -> None:
    from common.messages.schema import example_of, fields_of

    assert list(fields_of(topic.message))
    if topic.kind == "request" and topic.key != "motion/execute":
        example = example_of(topic.message)
        assert decode(f"panda/{topic.key}", encode(f"panda/{topic.key}", json.dumps(example)))
