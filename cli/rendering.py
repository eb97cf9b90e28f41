"""Messages as text: JSON in which bytes are named and never dumped, pictures as one line."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

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
