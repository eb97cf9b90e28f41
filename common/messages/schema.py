"""What a message is made of, in lines for people, and an example of a request."""

from __future__ import annotations

import base64
import json
import math
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

# What a person would send first, by message. Each is checked by a test.
EXAMPLES: dict[str, dict[str, Any]] = {
    "PlanRequest": {"id": "try-1", "goal": {"kind": "joints", "named": "home"}},
    "StopRequest": {"reason": "asked to"},
    "GripperCommand": {"id": "open-1", "width": 0.08},
    "WorldEdit": {"op": "add", "position": {"x": 0.45, "y": -0.1, "z": 0.03}},
    "SceneEdit": {"op": "add", "id": "post", "shape": "cylinder", "dimensions": [0.03, 0.6],
                  "pose": {"position": {"x": 0.2, "y": 0.5, "z": 0.3}}},
    "TaskCommand": {"command": "pause"},
}


def example_of(model: type[BaseModel]) -> dict[str, Any]:
    """An example of a request: one made of the fields that are required, or what a person would rather send."""
    return EXAMPLES.get(model.__name__) or {name: _sample(field.annotation) for name, field in _required(model)}


def fields_of(model: type[BaseModel], indent: int = 0, seen: tuple[type[BaseModel], ...] = ()) -> Iterator[str]:
    """The fields of a message and of the messages in it: name, type, default, description."""
    for name, field in model.model_fields.items():
        line = f"{'  ' * indent}{name}: {type_name(field.annotation)}"
        if bounds := ", ".join(text for text in map(_bound, field.metadata) if text):
            line += f" ({bounds})"
        if not field.is_required() and isinstance(field.default, str | int | float | bool):
            line += f" = {field.default!r}"
        if field.description:
            line += f"  # {field.description}"
        yield line
        for inner in models_in(field.annotation):
            if inner not in seen:
                yield from fields_of(inner, indent + 1, (*seen, inner))
    for name, computed in model.model_computed_fields.items():
        yield f"{'  ' * indent}{name}: {type_name(computed.return_type)}  # {computed.description}"


def type_name(annotation: Any) -> str:
    """A type as a person would write it."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return type_name(arguments[0])
    if origin is typing.Literal:
        return " | ".join(repr(value) for value in arguments)
    if origin in (typing.Union, types.UnionType):
        return " | ".join(type_name(argument) for argument in arguments)
    if origin is not None:
        inner = ", ".join("..." if argument is ... else type_name(argument) for argument in arguments)
        return f"{origin.__name__}[{inner}]"
    return "None" if annotation is type(None) else getattr(annotation, "__name__", str(annotation))


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that a type is made of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from models_in(argument)


def _bound(metadata: Any) -> str:
    for name, sign in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<=")):
        if getattr(metadata, name, None) is not None:
            return f"{sign} {getattr(metadata, name):g}"
    return ""


def _required(model: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    return ((name, field) for name, field in model.model_fields.items() if field.is_required())


def _sample(annotation: Any) -> Any:
    """A value of the type that is valid in most places."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _sample(arguments[0])
    if origin is typing.Literal or origin in (typing.Union, types.UnionType):
        return arguments[0] if origin is typing.Literal else _sample(arguments[0])
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {name: _sample(field.annotation) for name, field in _required(annotation)}
    if origin is list:
        return [_sample(arguments[0])]
    return {str: "name", int: 1, float: 0.0, bool: False}.get(annotation, [])


IMAGE_FIELDS = {"height", "width", "encoding", "data"}


def plain(value: Any) -> Any:
    """The value as JSON can hold it: bytes and numbers that are not finite become a description."""
    if isinstance(value, bytes | bytearray | memoryview):
        return f"<{len(value)} bytes>"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {key if isinstance(key, str) else str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    return repr(value)


def to_json(value: Any) -> str:
    """The value as one line of JSON."""
    return json.dumps(plain(value), ensure_ascii=False)


def is_image(value: Any) -> bool:
    """Whether a decoded payload is a picture."""
    return isinstance(value, Mapping) and value.keys() >= IMAGE_FIELDS and isinstance(value["data"], bytes)


def image_line(value: Mapping[str, Any]) -> str:
    """A picture in one line, as "Image 640x480 bgr8 921600 B stamp 1763737000.123 camera_optical_frame"."""
    line = f"Image {value['width']}x{value['height']} {value['encoding']} {len(value['data'])} B"
    header = value.get("header")
    if isinstance(header, Mapping):
        stamp = header.get("stamp")
        if isinstance(stamp, int):
            line += f" stamp {stamp / 1e9:.3f}"
        line += f" {header.get('frame_id', '')}"
    return line.rstrip()


def one_line(value: Any) -> str:
    """A decoded payload in one line: a picture as its description, anything else as JSON."""
    return image_line(value) if is_image(value) else to_json(value)


def from_json(value: Any) -> Any:
    """What a person wrote as JSON, with {"base64": "..."} turned into bytes."""
    if isinstance(value, dict):
        if value.keys() == {"base64"} and isinstance(value["base64"], str):
            return base64.b64decode(value["base64"], validate=True)
        return {key: from_json(item) for key, item in value.items()}
    return [from_json(item) for item in value] if isinstance(value, list) else value
