"""Writes the description of a cell to a folder."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common.errors import ConfigError
from common.supervision.wiring import ServiceWiring
from tools.wire.asyncapi import document, messages_of
from tools.wire.json_schema import message_schema


def to_text(value: Any) -> str:
    """Return a document as readable JSON."""
    return json.dumps(value, indent=2, ensure_ascii=False)


def write(cell: str, services: Sequence[ServiceWiring], endpoint: str, folder: Path) -> str:
    """Write asyncapi.json and messages/NAME.json to a folder, and return a line about them.

    Args:
        cell: its name.
        services: their keys.
        endpoint: of its router.
        folder: is created; files of the same names are replaced.

    Raises:
        ConfigError: the folder cannot be written.
    """
    described, models = document(cell, services, endpoint), messages_of(services)
    try:
        (folder / "messages").mkdir(parents=True, exist_ok=True)
        (folder / "asyncapi.json").write_text(to_text(described) + "\n", encoding="utf-8")
        for model in models:
            path = folder / "messages" / f"{model.__name__}.json"
            path.write_text(to_text(message_schema(model)) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError("--out", str(folder), f"cannot be written: {error.strerror or error}") from None
    return f"{folder}: {len(models)} messages, {len(described['channels'])} channels in asyncapi.json"
