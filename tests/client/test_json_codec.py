"""Messages as JSON: shown, sent and published."""

import json

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cli.main import app
from common import topics
from common.application import all_topics
from common.client.json_codec import decode, encode, message_from_json, stamped
from common.client.keys import published_topic
from common.clock import Clock
from common.errors import ConfigError, UnknownName
from common.messages import Header, Image, JointState, StopRequest
from common.messages.schema import example_of, fields_of
from common.transport.codec import decode as decode_message
from common.transport.codec import encode as encode_message

CLOCK = Clock(2.0, 1_000)
LEAVES = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary()

# --- shown ---


def test_image_is_one_line_and_another_message_is_json() -> None:
    image = Image(header=Header(stamp=1_500_000_000_250_000_000, frame_id="c"), height=480, width=640, encoding="bgr8",
                  data=bytes(921600))
    shown = decode("panda/camera/image_raw", encode_message(image))
    assert shown == "Image 640x480 bgr8 921600 B stamp 1500000000.250 c"
    state = JointState(header=Header(stamp=5), name=["a", "b"], position=[0.5, -1.0])
    assert json.loads(decode("panda/joint_states", encode_message(state))) == state.model_dump()
    assert decode("a/b", msgpack.packb({"blob": bytes(1000)})) == '{"blob": "<1000 bytes>"}'


@given(st.binary(max_size=200))
def test_garbage_is_one_line_and_never_an_exception(data: bytes) -> None:
    text = decode("panda/tf", data)
    assert text and "\n" not in text


@given(st.recursive(LEAVES, lambda some: st.lists(some) | st.dictionaries(st.text(), some), max_leaves=10))
def test_any_msgpack_is_one_line_and_a_map_is_json(value: object) -> None:
    text = decode("other/key", msgpack.packb(value))
    assert "\n" not in text
    if isinstance(value, dict) and not {"height", "width", "encoding", "data"} <= value.keys():
        json.loads(text)


def test_payload_that_is_not_a_map_is_reported() -> None:
    assert decode("a/b", b"A") == "<not a message: int 65>"
    assert decode("a/b", b"") == "<empty payload>"
    assert decode("a/b", b"\xc1 no").startswith("<not msgpack: 4 bytes c1206e6f: ")


# --- sent ---


@pytest.mark.parametrize("topic", all_topics().values(), ids=str)
def test_every_topic_can_be_described(topic: topics.AnyTopic) -> None:
    assert list(fields_of(topic.message))
    if topic.kind == "request" and topic.key != "motion/execute":
        key = f"panda/{topic.key}"
        assert decode(key, encode(key, json.dumps(example_of(topic.message))))


def test_message_of_a_known_or_unknown_key_is_encoded() -> None:
    payload = encode("panda/motion/stop?x=1", '{"reason": "lunch"}')
    assert decode_message(StopRequest, payload) == StopRequest(reason="lunch")
    assert msgpack.unpackb(encode("other/key", '{"a": {"base64": "AAE="}}')) == {"a": b"\x00\x01"}
    assert message_from_json(None, "my/key", '[1, null, {"a": {"base64": "AAE="}}]') == [1, None, {"a": b"\x00\x01"}]


@pytest.mark.parametrize(("key", "body", "message"), [
    ("panda/motion/stop", '{"raeson": "lunch"}',
     r"motion/stop\.raeson: 'lunch' is not a parameter; choices: by, id, owner, reason"),
    ("panda/motion/stop", "lunch", "is not JSON"), ("panda/motion/stop", "3", "must be a JSON object"),
    ("other/key", "1" + 30 * "0", "cannot be sent"), ("other/key", 100_000 * "[", "is not JSON"),
    ("panda/gripper/state", "{", "gripper/state: '{' is not JSON"),
    ("panda/gripper/state", "[1]", "must be a JSON object, a GripperState"),
    ("panda/gripper/state", '{"width": "wide"}', r"gripper/state.width: 'wide' must be a valid number"),
    ("panda/gripper/state", '{"header": 3, "width": 1}', r"gripper/state.header: 3"),
])
def test_invalid_message_names_the_field_and_the_choices(key: str, body: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        encode(key, body)


# --- published ---


def test_missing_headers_get_the_cell_time() -> None:
    message = message_from_json(topics.GRIPPER_STATE, "gripper/state", '{"width": 0.04}')
    before = CLOCK.now_ns()
    first, second = stamped(message, CLOCK), stamped(message, CLOCK)
    assert before <= first.header.stamp < second.header.stamp <= CLOCK.now_ns() and message.header.stamp == 0
    required = message_from_json(topics.JOINT_STATES, "joint_states", '{"name": ["a"], "position": [1]}')
    assert stamped(required, CLOCK).header.stamp > 0
    nested = message_from_json(topics.TF, "tf", '{"transforms": [{"header": {"frame_id": "a"}, "child_frame_id": "b",'
                                                ' "transform": {"position": {"x": 1}}}]}')
    (transform,) = stamped(nested, CLOCK).transforms
    assert transform.header.stamp > 0 and transform.header.frame_id == "a" and transform.transform.position.x == 1


@pytest.mark.parametrize(("header", "stamp"), [('{"stamp": 7, "frame_id": "x"}', 7), ('{"frame_id": "x"}', None)])
def test_given_stamp_and_frame_are_preserved(header: str, stamp: int | None) -> None:
    message = message_from_json(topics.GRIPPER_STATE, "gripper/state", f'{{"header": {header}, "width": 0}}')
    found = stamped(message, CLOCK).header
    assert found.frame_id == "x" and (found.stamp == stamp if stamp else found.stamp > 7)


@pytest.mark.parametrize("key", ["/joint_states", "joint_states/", "joint//states", "joint_states?", "joint states"])
def test_invalid_key_is_refused_with_a_suggestion(key: str) -> None:
    with pytest.raises(UnknownName, match=r"did you mean 'joint_states'\?"):
        published_topic(key)
    assert published_topic("my/**") is published_topic("my/*/key") is None


@pytest.mark.parametrize(("arguments", "message"), [
    (["pub", "motion/stop", "{}"], "'motion/stop' is a request, which is not published: zencell call motion/stop JSON"),
    (["pub", "param/vision_detector", "{}"], "is a request"),
    (["pub", "pick_place_status", '{"state": "FLY"}'], "pick_place_status.state: 'FLY' must be 'IDLE', 'GRASPING'"),
    (["pub", "tf", "{}", "--rate", "0"], "--rate: '0' must be more than 0 and at most 1000 [Hz]"),
    (["pub", "tf", "{}", "--count", "0"], "--count: '0'"),
    (["delay", "motion/stop"], "unknown published key 'motion/stop'"),
])
def test_bad_input_is_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert app.execute(["topic", *arguments]) == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert message in line and shown.out == ""
