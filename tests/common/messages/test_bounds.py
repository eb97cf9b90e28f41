"""Bounds of the fields of every message, also of messages in other packages."""

import math
from typing import Any

import msgpack
import pytest
from pydantic import Field

from common import messages as m
from common.errors import DecodeError
from common.messages.basics import MAX_PAYLOAD_BYTES, SMALL_BYTES, Message, Text, clean
from common.transport.codec import decode, encode
from tests.mutations import models

CONTROL = (m.JointState, m.StopRequest, m.HoldRequest, m.GripperCommand, m.GripperState, m.TaskCommand,
           m.ServiceCounters, m.LogLine)


class Polish(Message):
    """A message of a user's own package whose fields state few bounds."""

    gloss: float = 0.0
    count: int = 0
    dull: bool = False
    word: str = ""
    raw: bytes = b""
    rows: list[list[float]] = Field([])
    pair: tuple[float, float] = (0.0, 0.0)
    default: int = Field(0, ge=-1)


class Fraction(Message):
    """A message with a check that raises another error than a validator should."""

    text: Text = ""
    parts: int = 1

    def model_post_init(self, context: Any) -> None:
        1 // self.parts


def refused(model: type[Message], reason: str, **fields: Any) -> None:
    with pytest.raises(DecodeError, match=reason):
        decode(model, msgpack.packb(fields))


def nodes(schema: Any) -> list[dict[str, Any]]:
    """Return all parts of a schema that have a type."""
    if isinstance(schema, list | tuple):
        return [node for each in schema for node in nodes(each)]
    if not isinstance(schema, dict) or str(schema.get("ref")).startswith("pydantic.types.JsonValue"):
        return []  # a plain value is checked by a function of its own
    own = [schema] if isinstance(schema.get("type"), str) else []
    return own + [node for value in schema.values() for node in nodes(value)]


def test_every_number_and_list_of_every_message_is_bounded_and_strict() -> None:
    for model in (*models(), Polish):
        for node in nodes(model.__pydantic_core_schema__):
            match node["type"]:
                case "int" | "float":
                    assert node["strict"] and ({"ge", "gt"} & node.keys()) and ({"le", "lt"} & node.keys()), model
                case "str" | "bytes":
                    assert node["strict"] and node["max_length"] <= MAX_PAYLOAD_BYTES, model
                case "bool":
                    assert node["strict"], model
                case "list":
                    assert node["fail_fast"] and node["max_length"], model


def test_every_message_has_a_size_limit_and_control_messages_a_small_one() -> None:
    for model in models():
        assert SMALL_BYTES <= model.max_bytes <= MAX_PAYLOAD_BYTES
        with pytest.raises(DecodeError, match=f"the limit is {model.max_bytes}"):
            decode(model, bytes(model.max_bytes + 1))
    assert {model.max_bytes for model in CONTROL} == {SMALL_BYTES}


@pytest.mark.parametrize(("fields", "reason"), [
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
])
def test_values_of_another_type_are_refused_in_messages_of_other_packages(fields: dict[str, Any], reason: str) -> None:
    refused(Polish, reason, **fields)


def test_integer_is_accepted_as_a_number() -> None:
    assert decode(m.Vector3, msgpack.packb({"x": 1, "y": 2, "z": -3})) == m.Vector3(x=1.0, y=2.0, z=-3.0)


@pytest.mark.parametrize("name", ["\x1b[2J", "a\nb", "a\x00", "\x9b31m", "a\u202eb", "x" * 121])
def test_names_are_short_and_without_control_characters(name: str) -> None:
    refused(m.GripperCommand, r"GripperCommand\.id", id=name, width=0.0)
    refused(m.Header, r"Header\.frame_id", frame_id=name)


def test_free_text_is_cut_and_cleaned_and_never_refused() -> None:
    status = decode(m.MotionStatus, msgpack.packb({"message": "one\n\ttwo\x1b[2J\x9b" + "x" * 5000}))
    assert status.message.startswith("one\n\ttwo\\x1b[2J\\x9bxxx")
    assert len(status.message) == 4000
    assert decode(m.MotionStatus, encode(status)) == status
    assert m.MotionStatus(message="\ud800").message == "\\ud800"
    assert clean("Gr\u00fc\u00dfe \U0001f916") == "Gr\u00fc\u00dfe \U0001f916"


def test_any_error_of_a_check_refuses_the_message() -> None:
    refused(Fraction, "Fraction: ZeroDivisionError", parts=0)


def test_stamps_are_non_negative_integers_of_63_bits() -> None:
    assert decode(m.Header, msgpack.packb({"stamp": 2**63 - 1})).stamp == 2**63 - 1
    for stamp in (-1, 2**63, 2**64 - 1, "7", 1e9):
        refused(m.Header, r"Header\.stamp", stamp=stamp)


def nested(levels: int) -> Any:
    return [nested(levels - 1)] if levels else 1


@pytest.mark.parametrize(("value", "reason"), [
    (2**64 - 1, "64 bits"), (b"", "not bytes"), ("\x1b", "control"), ({"\x1b": 1}, "control"),
    (nested(20), "16 levels"),
])
def test_plain_values_have_the_bounds_of_fields(value: Any, reason: str) -> None:
    refused(m.ParameterRequest, reason, set={"a": value})


def test_invalid_outline_refuses_the_object() -> None:
    for outline in ({"12": 0, "34": 0, "56": 0, "78": 0}, 7, [[1, 2]], [["1", "2"]] * 4, [[1e308, -1e308]] * 4):
        refused(m.WorldObjects, "WorldObjects", objects=[{"id": "a", "shape": "box", "outline": outline, "height": -1}])


def test_messages_are_equal_if_their_fields_are() -> None:
    here, there = (m.Vector3(x=x) for x in (1.0, 2.0))
    assert here == m.Vector3(x=1.0, y=0.0) and here != there and here != m.Pose() and here != vars(here)
    assert here.equals_except(there, "x") and not here.equals_except(there, "y")
