"""Fields of a message as text, an example of each request, and decoded payloads as text."""

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

# A typical first request, by message. A test validates each.
EXAMPLES: dict[str, dict[str, Any]] = {
    "PlanRequest": {"id": "try-1", "goal": {"kind": "joints", "named": "home"}},
    "StopRequest": {"reason": "requested"},
    "GripperCommand": {"id": "open-1", "width": 0.08},
    "WorldEdit": {"op": "add", "position": {"x": 0.45, "y": -0.1, "z": 0.03}},
    "SceneEdit": {"op": "add", "id": "post", "shape": "cylinder", "dimensions": [0.03, 0.6],
                  "pose": {"position": {"x": 0.2, "y": 0.5, "z": 0.3}}},
    "TaskCommand": {"command": "pause"},
}


def example_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return an example of a request: a typical one, or one with the required fields only."""
    return EXAMPLES.get(model.__name__) or {name: _sample(field.annotation) for name, field in _required(model)}


def fields_of(model: type[BaseModel], indent: int = 0, seen: tuple[type[BaseModel], ...] = ()) -> Iterator[str]:
    """Yield the fields of a message and of its nested messages: name, type, default, description."""
    for name, field in model.model_fields.items():
        line = f"{'  ' * indent}{name}: {type_name(field.annotation)}"
        if bounds := ", ".join(text for text in map(_bound_text, field.metadata) if text):
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
    """Return the name of a type as in its annotation."""
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
    """Yield the models in a type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from models_in(argument)


def _bound_text(metadata: Any) -> str:
    for name, sign in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<=")):
        if getattr(metadata, name, None) is not None:
            return f"{sign} {getattr(metadata, name):g}"
    return ""


def _required(model: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    return ((name, field) for name, field in model.model_fields.items() if field.is_required())


def _sample(annotation: Any) -> Any:
    """Return a value of the type that most fields accept."""
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
    """Return the value for JSON: bytes and numbers that are not finite become a description."""
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
    """Return the value as one line of JSON."""
    return json.dumps(plain(value), ensure_ascii=False)


def is_image(value: Any) -> bool:
    """Return whether a decoded payload is an image."""
    return isinstance(value, Mapping) and value.keys() >= IMAGE_FIELDS and isinstance(value["data"], bytes)


def image_line(value: Mapping[str, Any]) -> str:
    """Return an image in one line: "Image 640x480 bgr8 921600 B stamp 1763737000.123 camera_optical_frame"."""
    line = f"Image {value['width']}x{value['height']} {value['encoding']} {len(value['data'])} B"
    header = value.get("header")
    if isinstance(header, Mapping):
        stamp = header.get("stamp")
        if isinstance(stamp, int):
            line += f" stamp {stamp / 1e9:.3f}"
        line += f" {header.get('frame_id', '')}"
    return line.rstrip()


def one_line(value: Any) -> str:
    """Return a decoded payload in one line: an image as its description, any other as JSON."""
    return image_line(value) if is_image(value) else to_json(value)


def from_json(value: Any) -> Any:
    """Return a parsed JSON value with {"base64": "..."} decoded to bytes."""
    if isinstance(value, dict):
        if value.keys() == {"base64"} and isinstance(value["base64"], str):
            return base64.b64decode(value["base64"], validate=True)
        return {key: from_json(item) for key, item in value.items()}
    return [from_json(item) for item in value] if isinstance(value, list) else value
