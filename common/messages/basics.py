"""Base class, field types and limits of all messages; points, poses and transforms."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from copy import deepcopy
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    JsonValue,
    PlainValidator,
    model_validator,
)
from pydantic_core import CoreSchema

SCHEMA_VERSION = 1
SMALL_BYTES = 16 * 1024  # of messages that are read in control loops: validating one takes less than 2 ms
MAX_PAYLOAD_BYTES = 32 * 1024 * 1024  # room for a 4096 x 2560 bgr8 image
MAX_STAMP = 2**63 - 1  # [ns since the Unix epoch]; in the year 2262
MAX_NAME = 120  # characters
MAX_JOINTS = 64
_MAX_TEXT = 4000  # characters
_MAX_REMARK = 500
_MAX_INT = 2**63 - 1
_MAX_FLOAT = 1e12  # squares and sums stay far from the limits of a float
_MAX_ITEMS = 200_000  # of a list or map without a limit of its own
_MAX_NESTED = 16  # levels of a plain value

# Control characters, and those that change the direction of text or start a line.
_IN_NAMES = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"
_ESCAPES = {
    code: ascii(chr(code))[1:-1]
    for codes in ((0, 9), (0xB, 0x20), (0x7F, 0xA0), (0x2028, 0x202F), (0x2066, 0x206A), (0xD800, 0xE000))
    for code in range(*codes)
}


def clean(text: str, limit: int = _MAX_TEXT) -> str:
    """Return free text for a message: cut to `limit` characters, with control characters escaped.

    Line feeds and tabs stay. Text never makes a message invalid: its other fields matter more.
    """
    cut = text[: limit + 1]
    if not cut.isprintable():
        cut = cut.translate(_ESCAPES)
    return cut if len(cut) <= limit else cut[: limit - 3] + "..."


def _clean_value(value: Any, limit: int) -> Any:
    return clean(value, limit) if isinstance(value, str) else value


def is_name(text: str) -> bool:
    """Return whether text is empty or a name: not too long, without control characters."""
    return len(text) <= MAX_NAME and (text.isprintable() or re.search(_IN_NAMES, text) is not None)


def _plain(value: Any) -> JsonValue:
    return _require_plain(value, _MAX_NESTED)


def _require_plain(value: Any, levels: int) -> JsonValue:
    """Return the value if all numbers and texts in it are allowed in a message.

    Raises:
        ValueError: names the rule that is broken.
    """
    match value:
        case bool() | float() | None:  # the field's own type checks bounds, and refuses values that are not finite
            pass
        case int():
            if not -_MAX_INT <= value <= _MAX_INT:
                raise ValueError("must be a number within 64 bits")
        case str():
            if clean(value) != value:
                raise ValueError(f"must be text of at most {_MAX_TEXT} characters without control characters")
        case _ if not levels:
            raise ValueError(f"must not be nested more than {_MAX_NESTED} levels deep")
        case list():
            for each in value:
                _require_plain(each, levels - 1)
        case dict():
            for name, each in value.items():
                _require_plain(name, levels - 1)
                _require_plain(each, levels - 1)
        case _:
            raise ValueError(f"must be a JSON value, not {type(value).__name__}")
    return value  # type: ignore[no-any-return]


Finite = Annotated[float, Field(ge=-_MAX_FLOAT, le=_MAX_FLOAT)]
Positive = Annotated[float, Field(gt=0, le=_MAX_FLOAT)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Metres = Annotated[float, Field(ge=-1e7, le=1e7)]  # room for a position on earth in a national grid
Seconds = Annotated[float, Field(ge=0, le=1e9)]
Count = Annotated[int, Field(ge=0, le=_MAX_INT)]
Name = Annotated[str, Field(min_length=1, max_length=MAX_NAME, pattern=_IN_NAMES)]
Label = Annotated[str, Field(max_length=MAX_NAME, pattern=_IN_NAMES)]  # a name, or empty
Text = Annotated[str, Field(max_length=_MAX_TEXT), BeforeValidator(lambda value: _clean_value(value, _MAX_TEXT))]
Remark = Annotated[
    str, Field(max_length=_MAX_REMARK), BeforeValidator(lambda value: _clean_value(value, _MAX_REMARK))]
Plain = Annotated[JsonValue, PlainValidator(_plain)]  # any JSON value

# Former names, which older programs, recordings and record files still contain: read, never written.
UNKNOWN_OPERATOR = "operator"  # name of an operator who gives none, and `by` of an operator's requests
SELF_RELEASING = (  # values of `by` whose holds end without an operator
    "watchdog", "controller", "scene_monitor", "coordinator")
FORMER_FIELDS: Mapping[str, str] = {"acknowledged": "heard", "interlocks": "inhibits"}
_FORMER_OPERATOR = "person"


def either_name(field: str) -> AliasChoices:
    """Return the `validation_alias` of a field that is also read under its former name."""
    return AliasChoices(field, FORMER_FIELDS[field])


def _rename_operator(value: Any) -> Any:
    return UNKNOWN_OPERATOR if value == _FORMER_OPERATOR else value


FormerOperator = BeforeValidator(_rename_operator)  # reads "person" as "operator"
OperatorName = Annotated[Label, FormerOperator]

_IMMUTABLE = frozenset({str, int, float, bool, bytes, type(None)})
_RULES: dict[str, dict[str, Any]] = {  # by type of a value, where a field has no rule of its own
    "float": {"strict": True, "allow_inf_nan": False, "ge": -_MAX_FLOAT, "le": _MAX_FLOAT},
    "int": {"strict": True, "ge": -_MAX_INT, "le": _MAX_INT},
    "str": {"strict": True, "max_length": MAX_PAYLOAD_BYTES},
    "bytes": {"strict": True, "max_length": MAX_PAYLOAD_BYTES},
    "bool": {"strict": True},
    "list": {"fail_fast": True, "max_length": _MAX_ITEMS},
    "tuple": {"fail_fast": True},
    "dict": {"max_length": _MAX_ITEMS},
}


def _add_rules(schema: Any) -> None:
    """Add the general rules to all parts of a schema that lack them."""
    if isinstance(schema, list | tuple):
        for each in schema:
            _add_rules(each)
    elif isinstance(schema, dict):
        kind = schema.get("type")
        if not isinstance(kind, str):  # a table of fields, one of which may be named `type`
            _add_rules(list(schema.values()))
            return
        for rule, value in _RULES.get(kind, {}).items():
            if not (rule == "ge" and "gt" in schema) and not (rule == "le" and "lt" in schema):
                schema.setdefault(rule, value)
        _add_rules([value for part, value in schema.items() if part not in ("default", "metadata", "serialization")])


class Message(BaseModel):  # noqa: PLW1641 - mutable, so it has no hash
    """Base of all messages.

    Beyond the rules of the fields: numbers and text are never converted into each other, numbers are finite and fit
    64 bits, lists have a limit, and the first invalid item of a list ends its validation.
    """

    # A process uses few of the messages, and building all validators takes as long as importing everything else. The
    # bus builds the validator of a message when it is declared (common/transport/bus.py).
    model_config = ConfigDict(extra="forbid", defer_build=True)

    max_bytes: ClassVar[int] = 1024 * 1024  # of an encoded message; readers and the router refuse larger ones
    max_parts: ClassVar[int] = 32 * 1024  # lists and maps in it at all levels: they cost most of the time to decode
    # Fields that are not sent while they hold their default: readers of former versions do not know them.
    omitted_defaults: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the rules of the fields with those of all messages."""
        schema = handler(source)
        _add_rules(schema)
        return schema

    def __eq__(self, other: object) -> bool:
        """Return whether all fields are equal; pydantic would also compare what messages never have."""
        return self.__dict__ == other.__dict__ if type(self) is type(other) else NotImplemented

    def equals_except(self, other: Self, *fields: str) -> bool:
        """Return whether all fields but these are equal."""
        return vars(self) | {name: getattr(other, name) for name in fields} == vars(other)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        """Return a copy that shares no mutable value; pydantic makes one of each default that is a message."""
        fields = self.__dict__.copy()
        for name, value in fields.items():
            if type(value) not in _IMMUTABLE:
                fields[name] = value.__deepcopy__(memo) if isinstance(value, Message) else deepcopy(value, memo)
        copied = self.__class__.__new__(self.__class__)
        object.__setattr__(copied, "__dict__", fields)
        object.__setattr__(copied, "__pydantic_fields_set__", set(self.__pydantic_fields_set__))
        object.__setattr__(copied, "__pydantic_extra__", None)
        object.__setattr__(copied, "__pydantic_private__", None)  # messages have none
        return copied


class Header(Message):
    """Time stamp and frame of a message."""

    stamp: int = Field(0, ge=0, le=MAX_STAMP, description="cell time [ns since the Unix epoch]")
    frame_id: Label = ""


Unit = Annotated[float, Field(ge=-1.001, le=1.001)]  # component of a unit quaternion
MAX_POSES = 256
Labels = Annotated[list[Label], Field(max_length=MAX_POSES)]
Corner = tuple[Metres, Metres]  # of a drawing in a plane [m]
Corners = Annotated[list[Corner], Field(max_length=2000)]


class Vector3(Message):
    """A point, displacement or box size [m]."""

    x: Metres = 0.0
    y: Metres = 0.0
    z: Metres = 0.0


class Quaternion(Message):
    """A unit quaternion; refused if its norm differs from 1 by more than 1e-3."""

    x: Unit = 0.0
    y: Unit = 0.0
    z: Unit = 0.0
    w: Unit = 1.0

    @model_validator(mode="after")
    def _require_unit_norm(self) -> Quaternion:
        norm = math.hypot(self.x, self.y, self.z, self.w)
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"quaternion has norm {norm:.4f}, not 1")
        return self


class Pose(Message):
    """Position [m] and orientation."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class PoseArray(Message):
    """Poses of several objects; `ids[i]` and `labels[i]`, if present, belong to `poses[i]`."""

    max_bytes: ClassVar[int] = 2 * SMALL_BYTES
    max_parts: ClassVar[int] = 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("unseen", "blind")

    header: Header = Header()
    poses: list[Pose] = Field([], max_length=MAX_POSES)
    ids: Labels = []
    labels: Labels = Field([], description="of ground truth: table, held, falling, box, or elsewhere (out of view); of "
                                           "perceived objects: hidden for one seen before it was occluded")
    remark: Text = Field("", description="what was detected and is none of the poses, and why")
    unseen: Text = Field("", description="which part of the area with objects the image did not show; empty: none")
    blind: bool = Field(False, description="the image showed nothing at all")

    @model_validator(mode="after")
    def _require_same_length(self) -> PoseArray:
        for field in ("ids", "labels"):
            count = len(getattr(self, field))
            if count not in (0, len(self.poses)):
                raise ValueError(f"{field} has {count} entries for {len(self.poses)} poses")
        return self


class TransformStamped(Message):
    """Pose of `child_frame_id` in `header.frame_id`."""

    header: Header
    child_frame_id: Name
    transform: Pose


class TFMessage(Message):
    """Transforms of one instant."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024

    transforms: list[TransformStamped] = Field(max_length=1000)


class Color(Message):
    """Red, green, blue and opacity, each 0 to 1."""

    r: Fraction = 1.0
    g: Fraction = 1.0
    b: Fraction = 1.0
    a: Fraction = 1.0
