"""What every message is made of."""

from __future__ import annotations

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
)
from pydantic_core import CoreSchema

SCHEMA_VERSION = 1
SMALL = 16 * 1024  # [bytes] for what is read where something moves: checking any such payload takes less than 2 ms
LARGEST = 32 * 1024 * 1024  # [bytes]; a 4096 x 2560 bgr8 picture still fits
MOST_STAMP = 2**63 - 1  # [ns since the Unix epoch]; in the year 2262
MOST_NAME = 120  # characters
MOST_JOINTS = 64
_MOST_TEXT = 4000  # characters
_MOST_REMARK = 500
_MOST_INT = 2**63 - 1
_MOST_FLOAT = 1e12  # what is squared or summed up stays far from the ends of a float
_MOST_ITEMS = 200_000  # of a list or a map that says nothing else
_MOST_NESTED = 16  # levels of a plain value

# Control characters, and those that change the direction of the text around them or begin a line.
_IN_NAMES = r"^[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]*$"
_ESCAPES = {
    code: ascii(chr(code))[1:-1]
    for codes in ((0, 9), (0xB, 0x20), (0x7F, 0xA0), (0x2028, 0x202F), (0x2066, 0x206A), (0xD800, 0xE000))
    for code in range(*codes)
}


def clean(text: str, most: int = _MOST_TEXT) -> str:
    """Free text as it may stand in a message: cut to `most` characters, control characters as escapes.

    Line feeds and tabs stay. What a message is about is worth more than how it is said, so text is never refused.
    """
    cut = text[: most + 1]
    if not cut.isprintable():
        cut = cut.translate(_ESCAPES)
    return cut if len(cut) <= most else cut[: most - 3] + "..."


def _cleaned(value: Any, most: int) -> Any:
    return clean(value, most) if isinstance(value, str) else value


def is_name(text: str) -> bool:
    """Whether text may be a name, or none: not too long, without control characters."""
    return len(text) <= MOST_NAME and (text.isprintable() or re.search(_IN_NAMES, text) is not None)


def _plain(value: Any) -> JsonValue:
    return _require_plain(value, _MOST_NESTED)


def _require_plain(value: Any, levels: int) -> JsonValue:
    """The value, when it holds nothing that a number or a name of a message may not be.

    Raises:
        ValueError: says what it is.
    """
    match value:
        case bool() | float() | None:  # whoever takes a number knows its bounds, and refuses what is not finite
            pass
        case int():
            if not -_MOST_INT <= value <= _MOST_INT:
                raise ValueError("must be a number within 64 bits")
        case str():
            if clean(value) != value:
                raise ValueError(f"must be text of at most {_MOST_TEXT} characters without control characters")
        case _ if not levels:
            raise ValueError(f"must not be nested more than {_MOST_NESTED} levels deep")
        case list():
            for each in value:
                _require_plain(each, levels - 1)
        case dict():
            for name, each in value.items():
                _require_plain(name, levels - 1)
                _require_plain(each, levels - 1)
        case _:
            raise ValueError(f"must be what JSON can say, not {type(value).__name__}")
    return value  # type: ignore[no-any-return]


Finite = Annotated[float, Field(ge=-_MOST_FLOAT, le=_MOST_FLOAT)]
Positive = Annotated[float, Field(gt=0, le=_MOST_FLOAT)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Metres = Annotated[float, Field(ge=-1e7, le=1e7)]  # a place on earth in a national grid still is one
Seconds = Annotated[float, Field(ge=0, le=1e9)]
Count = Annotated[int, Field(ge=0, le=_MOST_INT)]
Name = Annotated[str, Field(min_length=1, max_length=MOST_NAME, pattern=_IN_NAMES)]
Label = Annotated[str, Field(max_length=MOST_NAME, pattern=_IN_NAMES)]  # a name, or empty for none
Text = Annotated[str, Field(max_length=_MOST_TEXT), BeforeValidator(lambda value: _cleaned(value, _MOST_TEXT))]
Remark = Annotated[str, Field(max_length=_MOST_REMARK), BeforeValidator(lambda value: _cleaned(value, _MOST_REMARK))]
Plain = Annotated[JsonValue, PlainValidator(_plain)]  # what JSON can say
# Names of the first releases, which older programs, recordings and record files still hold: read, never written.
UNKNOWN_OPERATOR = "operator"  # name of an operator who gives none, and `by` of what an operator requests
SELF_RELEASING = ("watchdog", "controller", "scene_monitor")  # values of `by` whose holds end without an operator
FORMER_FIELDS: Mapping[str, str] = {"acknowledged": "heard", "interlocks": "inhibits"}
_FORMER_OPERATOR = "person"


def either_name(field: str) -> AliasChoices:
    """Return the `validation_alias` of a field that is also read under its former name."""
    return AliasChoices(field, FORMER_FIELDS[field])


def _rename_operator(value: Any) -> Any:
    return UNKNOWN_OPERATOR if value == _FORMER_OPERATOR else value


FormerOperator = BeforeValidator(_rename_operator)  # reads "person" as "operator"
OperatorName = Annotated[Label, FormerOperator]
_UNCHANGING = frozenset({str, int, float, bool, bytes, type(None)})


_RULES: dict[str, dict[str, Any]] = {  # by kind of value, where a field says nothing else
    "float": {"strict": True, "allow_inf_nan": False, "ge": -_MOST_FLOAT, "le": _MOST_FLOAT},
    "int": {"strict": True, "ge": -_MOST_INT, "le": _MOST_INT},
    "str": {"strict": True, "max_length": LARGEST},
    "bytes": {"strict": True, "max_length": LARGEST},
    "bool": {"strict": True},
    "list": {"fail_fast": True, "max_length": _MOST_ITEMS},
    "tuple": {"fail_fast": True},
    "dict": {"max_length": _MOST_ITEMS},
}


def _bound(schema: Any) -> None:
    """Give all parts of a schema the rules that they have not."""
    if isinstance(schema, list | tuple):
        for each in schema:
            _bound(each)
    elif isinstance(schema, dict):
        kind = schema.get("type")
        if not isinstance(kind, str):  # a table of fields, one of which may be called `type`
            _bound(list(schema.values()))
            return
        for rule, value in _RULES.get(kind, {}).items():
            if not (rule == "ge" and "gt" in schema) and not (rule == "le" and "lt" in schema):
                schema.setdefault(rule, value)
        _bound([value for part, value in schema.items() if part not in ("default", "metadata", "serialization")])



class Message(BaseModel):  # noqa: PLW1641 - it can change, and so has no hash
    """Base of everything that is sent.

    Whatever the fields of a message say of themselves: numbers are numbers and text is text, never one for the other;
    they are finite and within 64 bits, lists have an end; the first entry of a list that does not fit ends it.
    """

    # Each process uses a few of them: to build the rules of all takes as long as importing all else. Who is about to
    # read or write one builds its rules first (common/transport/bus.py).
    model_config = ConfigDict(extra="forbid", defer_build=True)

    most_bytes: ClassVar[int] = 1024 * 1024  # of an encoded message; readers and the router take no more
    most_parts: ClassVar[int] = 32 * 1024  # lists and maps in it, all levels together: they cost most time to read
    later: ClassVar[tuple[str, ...]] = ()  # fields that are sent only where they say something: others do not know them

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """The rules of the fields, each with what holds for all messages."""
        schema = handler(source)
        _bound(schema)
        return schema

    def __eq__(self, other: object) -> bool:
        """Whether all fields are the same: messages have nothing else, for which pydantic would look."""
        return self.__dict__ == other.__dict__ if type(self) is type(other) else NotImplemented

    def same_but(self, other: Self, *fields: str) -> bool:
        """Whether all is the same but for these fields."""
        return vars(self) | {name: getattr(other, name) for name in fields} == vars(other)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        """A copy that shares nothing that can be changed; pydantic makes one of each default that is a message."""
        fields = self.__dict__.copy()
        for name, value in fields.items():
            if type(value) not in _UNCHANGING:
                fields[name] = value.__deepcopy__(memo) if isinstance(value, Message) else deepcopy(value, memo)
        copied = self.__class__.__new__(self.__class__)
        object.__setattr__(copied, "__dict__", fields)
        object.__setattr__(copied, "__pydantic_fields_set__", set(self.__pydantic_fields_set__))
        object.__setattr__(copied, "__pydantic_extra__", None)
        object.__setattr__(copied, "__pydantic_private__", None)  # messages have none
        return copied


class Header(Message):
    """When and in which frame."""

    stamp: int = Field(0, ge=0, le=MOST_STAMP, description="cell time [ns since the Unix epoch]")
    frame_id: Label = ""

