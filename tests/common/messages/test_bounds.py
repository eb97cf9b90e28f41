"""What holds for the fields of every message, those of applications and of a person's own too."""

import math
from typing import Any

import msgpack
import pytest
from pydantic import Field

from common import messages as m
from common.application import all_topics
from common.errors import DecodeError
from common.messages.basics import MAX_PAYLOAD_BYTES, SMALL_BYTES, Message, Text, clean
from common.transport.codec import decode, encode

MESSAGES = sorted(
    {model for topic in all_topics().values() for model in (topic.message, getattr(topic, "answer", topic.message))},
    key=lambda model: model.__name__,
)
CONTROL = (m.JointState, m.StopRequest, m.HoldRequest, m.GripperCommand, m.GripperState, m.TaskCommand,
           m.ServiceCounters, m.LogLine)


class Polish(Message):
    """A message of somebody's own that says little of its fields."""

    gloss: float = 0.0
    count: int = 0
    dull: bool = False
    word: str = ""
    raw: bytes = b""
    rows: list[list[float]] = Field([])
    pair: tuple[float, float] = (0.0, 0.0)
    default: int = Field(0, ge=-1)


def pack(**fields: Any) -> bytes:
    packed: bytes = msgpack.packb(fields)
    return packed


def nodes(schema: Any) -> list[dict[str, Any]]:
    """All parts of a schema that say what kind of value they are."""
    if isinstance(schema, list | tuple):
        return [node for each in schema for node in nodes(each)]
    if not isinstance(schema, dict) or str(schema.get("ref")).startswith("pydantic.types.JsonValue"):
        return []  # a plain value is checked by a function of its own
    own = [schema] if isinstance(schema.get("type"), str) else []
    return own + [node for value in schema.values() for node in nodes(value)]


@pytest.mark.parametrize("model", [*MESSAGES, Polish])
def test_every_number_is_bounded_and_every_list_ends_at_its_first_error(model: type[Message]) -> None:
    for node in nodes(model.__pydantic_core_schema__):
        match node["type"]:
            case "int" | "float":
                assert node["strict"] and ({"ge", "gt"} & node.keys()) and ({"le", "lt"} & node.keys())
            case "str" | "bytes":
                assert node["strict"] and node["max_length"] <= MAX_PAYLOAD_BYTES
            case "bool":
                assert node["strict"]
            case "list":
                assert node["fail_fast"] and node["max_length"]


@pytest.mark.parametrize("model", MESSAGES)
def test_a_message_says_how_large_it_may_be(model: type[Message]) -> None:
    assert SMALL_BYTES <= model.max_bytes <= MAX_PAYLOAD_BYTES
    with pytest.raises(DecodeError, match=f"the limit is {model.max_bytes}"):
        decode(model, bytes(model.max_bytes + 1))


@pytest.mark.parametrize("model", CONTROL)
def test_what_is_read_where_something_moves_is_small(model: type[Message]) -> None:
    assert model.max_bytes == SMALL_BYTES


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"gloss": "1.0"}, "gloss: must be a valid number"),
        ({"gloss": True}, "gloss: must be a valid number"),
        ({"gloss": math.inf}, "gloss: must be a finite number"),
        ({"gloss": 1e200}, "gloss: must be less than or equal to"),
        ({"count": "9" * 400}, "count: must be a valid integer"),
        ({"count": 1.0}, "count: must be a valid integer"),
        ({"count": 2**64 - 1}, "count: must be less than or equal to"),
        ({"dull": 1}, "dull: must be a valid boolean"),
        ({"word": b"bytes"}, "word: must be a valid string"),
        ({"raw": "text"}, "raw: must be a valid bytes"),
        ({"rows": [[1.0], ["2"], ["3"]]}, r"rows\.1\.0: must be a valid number, not '2'$"),
        ({"pair": ["1", "2"]}, r"pair\.0: must be a valid number, not '1'$"),
        ({"default": "0"}, "default: must be a valid integer"),
    ],
)
def test_messages_of_ones_own_take_nothing_for_something_else(fields: dict[str, Any], reason: str) -> None:
    with pytest.raises(DecodeError, match=reason):
        decode(Polish, pack(**fields))


def test_a_whole_number_is_a_number() -> None:
    assert decode(m.Vector3, pack(x=1, y=2, z=-3)) == m.Vector3(x=1.0, y=2.0, z=-3.0)


@pytest.mark.parametrize("name", ["\x1b[2J", "a\nb", "a\x00", "\x9b31m", "a\u202eb", "x" * 121])
def test_names_are_short_and_without_control_characters(name: str) -> None:
    with pytest.raises(DecodeError, match=r"CollisionObject\.id|GripperCommand\.id"):
        decode(m.GripperCommand, pack(id=name, width=0.0))
    with pytest.raises(DecodeError, match=r"Header\.frame_id"):
        decode(m.Header, pack(frame_id=name))


def test_free_text_is_cut_and_cleaned_and_never_refused() -> None:
    status = decode(m.MotionStatus, pack(message="one\n\ttwo\x1b[2J\x9b" + "x" * 5000))
    assert status.message.startswith("one\n\ttwo\\x1b[2J\\x9bxxx")
    assert len(status.message) == 4000
    assert decode(m.MotionStatus, encode(status)) == status
    assert m.MotionStatus(message="\ud800").message == "\\ud800"
    assert clean("Gr\u00fc\u00dfe \U0001f916") == "Gr\u00fc\u00dfe \U0001f916"


class Said(Message):
    """Something with a check that did not think of everything."""

    text: Text = ""
    parts: int = 1

    def model_post_init(self, context: Any) -> None:
        """Fail as a program does."""
        1 // self.parts


def test_a_check_that_fails_otherwise_refuses_the_message_too() -> None:
    with pytest.raises(DecodeError, match="Said: ZeroDivisionError"):
        decode(Said, pack(parts=0))


def test_stamps_are_within_what_dates_bear() -> None:
    assert decode(m.Header, pack(stamp=2**63 - 1)).stamp == 2**63 - 1
    for stamp in (-1, 2**63, 2**64 - 1, "7", 1e9):
        with pytest.raises(DecodeError, match=r"Header\.stamp"):
            decode(m.Header, pack(stamp=stamp))


@pytest.mark.parametrize(
    ("value", "reason"),
    [(2**64 - 1, "64 bits"), (b"", "not bytes"), ("\x1b", "control"), ({"\x1b": 1}, "control")],
)
def test_plain_values_hold_what_fields_may_hold(value: Any, reason: str) -> None:
    with pytest.raises(DecodeError, match=reason):
        decode(m.ParameterRequest, pack(set={"a": value}))


def test_an_outline_of_something_else_refuses_the_object() -> None:
    for outline in ({"12": 0, "34": 0, "56": 0, "78": 0}, 7, [[1, 2]], [["1", "2"]] * 4, [[1e308, -1e308]] * 4):
        with pytest.raises(DecodeError, match=r"WorldObjects"):
            decode(m.WorldObjects, pack(objects=[{"id": "a", "shape": "box", "outline": outline, "height": -1}]))


def test_plain_values_are_not_nested_deeply() -> None:
    value: Any = 1
    for _ in range(20):
        value = [value]
    with pytest.raises(DecodeError, match="16 levels"):
        decode(m.ParameterRequest, pack(set={"a": value}))


def test_messages_are_the_same_when_their_fields_are() -> None:
    here, there = (m.Vector3(x=x) for x in (1.0, 2.0))
    assert here == m.Vector3(x=1.0, y=0.0) and here != there and here != m.Pose() and here != vars(here)
    assert here.equals_except(there, "x") and not here.equals_except(there, "y")
