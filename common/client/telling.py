"""What comes on a key of a cell, a line each for people or programs: messages, and figures about them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from functools import partial
from pathlib import Path
from typing import Any

import msgpack

from common.client import delay
from common.client import statistics as measuring
from common.client.foreign import require_messages, samples
from common.client.json_codec import decode
from common.client.subscriptions import Carried, find_live_topic
from common.errors import ConfigError
from common.messages.schema import example_of, fields_of, one_line, to_json
from common.topics import Topic
from common.transport.bus import Bus


def require_pictures(topic: Carried | None, key: str, save: str) -> None:
    """Return when pictures of a topic, if that is known, can be kept in a file of that name.

    Raises:
        ConfigError: they cannot.
    """
    if not save.lower().endswith(".png") or not Path(save).parent.is_dir():
        raise ConfigError("--save", save, "must be the name of a .png file in a folder that is there")
    if topic is not None and topic.message.__name__ != "Image":
        raise ConfigError("--save", save, f"is for pictures: {key} carries {topic.message.__name__}")


async def messages(
    bus: Bus, topic: Topic[Any] | None, key: str, *, as_json: bool = False, save: str = ""
) -> AsyncGenerator[str, None]:
    """What comes on a key, a line each.

    Args:
        bus: in the cell.
        topic: of the key; None for one that the project does not have, of which only its owner may say more.
        key: without the cell.
        as_json: one JSON object a line.
        save: a file in which the newest picture is kept.

    Raises:
        ConfigError: pictures are to be kept, and the key carries others.
        SilentKey: nothing comes on a key that nobody knows.
    """
    found = topic or await find_live_topic(bus, key)
    if save and found is None:
        raise ConfigError("--save", save, f"is for pictures: nobody says what {key} carries")
    if save:
        require_pictures(found, key, save)
    lines = _of_topic(bus, found, as_json, save) if isinstance(found, Topic) else _foreign(bus, key, as_json)
    async with aclosing(lines):
        async for line in lines:
            yield line


async def _of_topic(bus: Bus, topic: Topic[Any], as_json: bool, save: str) -> AsyncGenerator[str, None]:
    async for message in bus.reader(topic):
        if save:
            from common.perception.image import save_image

            await asyncio.to_thread(save_image, message, Path(save))
        yield to_json(message.model_dump()) if as_json else one_line(message.model_dump())


async def _foreign(bus: Bus, key: str, as_json: bool) -> AsyncGenerator[str, None]:
    async with aclosing(samples(bus, key)) as coming:
        async for sample in coming:
            line = decode(sample.key, sample.payload)
            whole = as_json and not line.startswith("<")  # what is no message has no other form
            yield to_json(msgpack.unpackb(sample.payload, raw=False, strict_map_key=False)) if whole else line


async def _rates(bus: Bus, key: str, foreign: bool, *, in_bytes: bool) -> AsyncGenerator[tuple[Any, str], None]:
    if foreign:
        await require_messages(bus, key)
    async for figures in measuring.windows(bus, f"{bus.cell}/{key}"):
        yield figures, measuring.describe(figures, in_bytes=in_bytes)


FIGURES: dict[str, Callable[[Bus, str, bool], AsyncGenerator[tuple[Any, str], None]]] = {
    "hz": partial(_rates, in_bytes=False), "bw": partial(_rates, in_bytes=True), "delay": delay.delays,
}


async def figures(
    bus: Bus, topic: Topic[Any] | None, key: str, kind: str, *, as_json: bool = False
) -> AsyncGenerator[str, None]:
    """Figures about what comes on a key, a line each second.

    Args:
        bus: in the cell.
        topic: of the key; None for one that the project does not have.
        key: without the cell.
        kind: a name of FIGURES.
        as_json: one JSON object a line.

    Raises:
        SilentKey: nothing comes on a key that the project does not have.
        NoStamp: nothing says how old the messages are.
    """
    async with aclosing(FIGURES[kind](bus, topic.expression if topic else key, topic is None)) as coming:
        async for found, line in coming:
            yield json.dumps({"key": key, **found}) if as_json else line


def described(topic: Carried, writer: str) -> dict[str, Any]:
    """What a topic carries as JSON can hold it; of a request also the answer and an example."""
    found: dict[str, Any] = {
        "key": topic.key, "kind": topic.kind, "writer": writer, "doc": topic.doc,
        "message": topic.message.__name__, "schema": topic.message.model_json_schema(),
    }
    if answer := getattr(topic, "answer", None):
        found |= {"answer": answer.__name__, "answer_schema": answer.model_json_schema()}
        found["example"] = example_of(topic.message)
    return found


def description(topic: Carried, writer: str) -> list[str]:
    """What a topic carries in lines for people, field by field."""
    answer = getattr(topic, "answer", None)
    lines = [f"{topic.key}: {topic.doc}", f"kind: {topic.kind}",
             f"{'served' if answer else 'written'} by: {writer or 'nobody here'}"]
    for what, model in (("message", topic.message), ("answer", answer)):
        if model:
            lines += [f"{what}: {model.__name__}", *(f"  {line}" for line in fields_of(model))]
    if answer:
        lines.append(f"example: zencell call {topic.key} '{json.dumps(example_of(topic.message))}'")
    return lines
