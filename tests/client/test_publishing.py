import pytest

from cli.main import app
from common import topics
from common.client.json_codec import message_from_json, stamped
from common.client.keys import published_topic
from common.clock import Clock
from common.errors import ConfigError, UnknownName

CLOCK = Clock(2.0, 1_000)


def test_missing_header_gets_the_cell_time() -> None:
    message = message_from_json(topics.GRIPPER_STATE, "gripper/state", '{"width": 0.04}')
    before = CLOCK.now_ns()
    first, second = stamped(message, CLOCK), stamped(message, CLOCK)
    assert before <= first.header.stamp < second.header.stamp <= CLOCK.now_ns()
    assert message.header.stamp == 0


def test_required_header_may_be_omitted() -> None:
    message = message_from_json(topics.JOINT_STATES, "joint_states", '{"name": ["a"], "position": [1]}')
    assert stamped(message, CLOCK).header.stamp > 0


def test_given_stamp_and_frame_are_preserved() -> None:
    message = message_from_json(topics.GRIPPER_STATE, "gripper/state",
                                '{"header": {"stamp": 7, "frame_id": "x"}, "width": 0}')
    assert stamped(message, CLOCK).header == message.header
    message = message_from_json(topics.GRIPPER_STATE, "gripper/state", '{"header": {"frame_id": "x"}, "width": 0}')
    assert stamped(message, CLOCK).header.frame_id == "x"
    assert stamped(message, CLOCK).header.stamp > 7


def test_nested_headers_are_stamped() -> None:
    message = message_from_json(topics.TF, "tf", '{"transforms": [{"header": {"frame_id": "a"}, "child_frame_id": "b",'
                                       ' "transform": {"position": {"x": 1}}}]}')
    (transform,) = stamped(message, CLOCK).transforms
    assert transform.header.stamp > 0
    assert transform.header.frame_id == "a"
    assert transform.transform.position.x == 1


def test_unknown_key_takes_any_json() -> None:
    assert message_from_json(
        None, "my/key", "[1, null, {\"a\": {\"base64\": \"AAE=\"}}]") == [1, None, {"a": b"\x00\x01"}]


@pytest.mark.parametrize(("body", "wanted"), [
    ("{", "gripper/state: '{' is not JSON"),
    ("[1]", "must be a JSON object, a GripperState"),
    ('{"widht": 1}', r"gripper/state.widht: 1 is not a parameter; choices: .*width"),
    ('{"width": "wide"}', r"gripper/state.width: 'wide' must be a valid number"),
    ('{"header": 3, "width": 1}', r"gripper/state.header: 3"),
])
def test_invalid_message_names_the_field_and_the_choices(body: str, wanted: str) -> None:
    with pytest.raises(ConfigError, match=wanted):
        message_from_json(topics.GRIPPER_STATE, "gripper/state", body)


@pytest.mark.parametrize("key", ["/joint_states", "joint_states/", "joint//states", "joint_states?", "joint states"])
def test_invalid_key_is_refused_with_a_suggestion(key: str) -> None:
    with pytest.raises(UnknownName, match=r"did you mean 'joint_states'\?"):
        published_topic(key)
    assert published_topic("my/**") is published_topic("my/*/key") is None


@pytest.mark.parametrize(("body", "wanted"), [
    ("[" * 100_000, "is not JSON"), ('{"a": 1' + 30 * "0" + "}", "cannot be sent"),
])
def test_json_that_cannot_be_sent_is_refused(body: str, wanted: str) -> None:
    with pytest.raises(ConfigError, match=wanted):
        message_from_json(None, "my/key", body)


@pytest.mark.parametrize(("arguments", "wanted"), [
    (["pub", "motion/stop", "{}"], "'motion/stop' is a request, which is not published: zencell call motion/stop JSON"),
    (["pub", "param/vision_detector", "{}"], "is a request"),
    (["pub", "pick_place_status", '{"state": "FLY"}'], "pick_place_status.state: 'FLY' must be 'IDLE', 'GRASPING'"),
    (["pub", "tf", "{}", "--rate", "0"], "--rate: '0' must be more than 0 and at most 1000 [Hz]"),
    (["pub", "tf", "{}", "--count", "0"], "--count: '0'"),
    (["delay", "motion/stop"], "unknown published key 'motion/stop'"),
])
def test_bad_input_is_one_line(
    arguments: list[str], wanted: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert app.execute(["topic", *arguments]) == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert wanted in line
    assert shown.out == ""
