"""Inspecting a cell by hand: descriptions of topics and services, messages as lines of text, and publishing."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping
from contextlib import aclosing
from pathlib import Path
from typing import Any

import msgpack

from common import topics as keys
from common.client.joining import RunningCell, joined
from common.client.json_codec import decode, stamped
from common.client.keys import SILENCE, raw_samples, writers_of
from common.client.subscriptions import AnyTopic, NothingReceived, find_live_topic
from common.config import Cell, ServiceEntry, load_cell, names_of, service_names
from common.config.tunables import describe
from common.errors import ConfigError, RequestFailed, UnknownName
from common.messages import Parameter, ParameterRequest, ServiceStatus
from common.messages.schema import example_of, fields_of, one_line, to_json
from common.supervision.wiring import ServiceWiring
from common.topics import Topic
from common.transport.bus import Bus
from common.transport.codec import MSGPACK
from common.transport.session import ROUTER

TIMEOUT = 2.0  # [s] for the parameters of a service
SIDES = ("reads", "writes", "serves", "calls")
MATCH_TIMEOUT = 1.0  # [s] for subscribers to be found before the first message
MATCH_PERIOD = 0.02  # [s]
LINGER = 0.1  # [s] after the last message, in which the network sends it


def topic_description(topic: AnyTopic, writer: str) -> dict[str, Any]:
    """Return a topic as JSON; of a request also the answer and an example."""
    found: dict[str, Any] = {
        "key": topic.key, "kind": topic.kind, "writer": writer, "doc": topic.doc,
        "message": topic.message.__name__, "schema": topic.message.model_json_schema(),
    }
    if answer := getattr(topic, "answer", None):
        found |= {"answer": answer.__name__, "answer_schema": answer.model_json_schema()}
        found["example"] = example_of(topic.message)
    return found


def topic_lines(topic: AnyTopic, writer: str) -> list[str]:
    """Return a topic as lines of text, field by field."""
    answer = getattr(topic, "answer", None)
    lines = [f"{topic.key}: {topic.doc}", f"kind: {topic.kind}",
             f"{'served' if answer else 'written'} by: {writer or 'no known service'}"]
    for what, model in (("message", topic.message), ("answer", answer)):
        if model:
            lines += [f"{what}: {model.__name__}", *(f"  {line}" for line in fields_of(model))]
    if answer:
        lines.append(f"example: zencell call {topic.key} '{json.dumps(example_of(topic.message))}'")
    return lines


def require_images(topic: AnyTopic | None, key: str, save: str) -> None:
    """Check that images of a topic, if known, can be saved in a file.

    Raises:
        ConfigError: they cannot.
    """
    if not save.lower().endswith(".png") or not Path(save).parent.is_dir():
        raise ConfigError("--save", save, "must be a .png file in an existing folder")
    if topic is not None and topic.message.__name__ != "Image":
        raise ConfigError("--save", save, f"is for images: {key} carries {topic.message.__name__}")


async def message_lines(
    bus: Bus, topic: Topic[Any] | None, key: str, as_json: bool, save: str
) -> AsyncGenerator[str, None]:
    """Yield a line for each message of a key; of an unknown key the running cell may know the topic."""
    found = topic or await find_live_topic(bus, key)
    if save and found is None:
        raise ConfigError("--save", save, f"is for images: it is unknown what {key} carries")
    if save:
        require_images(found, key, save)
    lines = _known_lines(bus, found, as_json, save) if isinstance(found, Topic) else _unknown_lines(bus, key, as_json)
    async with aclosing(lines):
        async for line in lines:
            yield line


async def noting_silence(
    bus: Bus, lines: AsyncGenerator[str, None], key: str, timeout: float | None, note: Callable[[str], None],
) -> AsyncGenerator[str, None]:
    """Yield the lines; note once in a silence that no service publishes the key, if it is given.

    Raises:
        NothingReceived: no line came within `timeout` [s].
    """
    async with aclosing(lines):
        while True:
            line = asyncio.ensure_future(anext(lines, None))
            try:
                first = SILENCE if timeout is None else min(SILENCE, timeout)
                done, _ = await asyncio.wait({line}, timeout=first)
                if not done and key and not await writers_of(bus, [key]):
                    note(f"zencell: no service publishes {key} now")
                if not done:
                    done, _ = await asyncio.wait({line}, timeout=None if timeout is None else timeout - first)
                if not done:
                    raise NothingReceived(f"{bus.cell}/{key}", timeout or 0.0)
                if (found := await line) is None:
                    return
            finally:
                line.cancel()
                await asyncio.wait({line})
            yield found


async def _known_lines(bus: Bus, topic: Topic[Any], as_json: bool, save: str) -> AsyncGenerator[str, None]:
    async for message in bus.reader(topic):
        if save:
            from common.perception.image import save_image

            await asyncio.to_thread(save_image, message, Path(save))
        yield to_json(message.model_dump()) if as_json else one_line(message.model_dump())


async def _unknown_lines(bus: Bus, key: str, as_json: bool) -> AsyncGenerator[str, None]:
    async with aclosing(raw_samples(bus, key)) as samples:
        async for sample in samples:
            line = decode(sample.key, sample.payload)
            is_message = as_json and not line.startswith("<")
            yield (to_json(msgpack.unpackb(sample.payload, raw=False, strict_map_key=False)) if is_message else line)


async def publish(
    bus: Bus, topic: Topic[Any] | None, key: str, message: Any, period: float, most: int | None
) -> None:
    """Publish a message repeatedly, each time with a new stamp.

    Args:
        bus: in the cell.
        topic: of the key; None for an unknown key.
        key: of the topic, without the cell.
        message: result of `message_from_json`.
        period: between two messages [s, wall].
        most: number of messages; None: no limit.
    """

    writer = bus.writer(topic) if topic is not None else bus.raw_writer(f"{bus.cell}/{key}", MSGPACK, "event")

    def current() -> Any:
        if topic is not None:
            return stamped(message, bus.clock)
        value = message
        if isinstance(value, dict) and isinstance(header := value.get("header"), dict):
            value = {**value, "header": {"stamp": bus.clock.now_ns(), **header}}
        return msgpack.packb(value, use_bin_type=True)

    for _ in range(int(MATCH_TIMEOUT / MATCH_PERIOD)):  # subscribers are known a moment after the declaration
        if writer.matched:
            break
        await asyncio.sleep(MATCH_PERIOD)
    began, sent = time.monotonic(), 0
    while True:
        writer.put(current())
        sent += 1
        if sent == most:
            break
        await asyncio.sleep(max(0.0, began + sent * period - time.monotonic()))
    await asyncio.sleep(LINGER)


def find_service(service: str, cell: str | None, cells: dict[str, RunningCell]) -> tuple[Cell, ServiceEntry]:
    """Return the cell of a service, running cells first, and its entry there.

    Raises:
        ConfigError, UnknownName: there is none.
    """
    names = [cell] if cell else sorted(names_of("cells"), key=lambda name: (name not in cells, name))
    known = {name for name in service_names() if name != ROUTER}
    for name in names:
        loaded = load_cell(name)
        for entry in loaded.services.values():
            if service in (entry.name, entry.module):
                return loaded, entry
            known.add(entry.name)
    if service not in known:
        raise UnknownName("service", service, known)
    # No cell has it: describe it as it would be in the first cell.
    return load_cell(names[0]), ServiceEntry(name=service, module=f"services.{service}")


async def service_parameters(
    wiring: ServiceWiring, cell: str, running: RunningCell | None, domain: str | None, connect: str | None
) -> tuple[list[Parameter], RequestFailed | None]:
    """Return the parameters of the running service; else those of the cell file, and why it did not answer."""
    failure = None
    if running is not None and wiring.name in running.ready:
        try:
            async with joined(cell, domain=domain, connect=connect) as bus:
                client = bus.client(keys.parameters_of(wiring.name))
                return (await client.call(ParameterRequest(), TIMEOUT)).parameters, None
        except RequestFailed as error:
            failure = error
    assert wiring.config is not None
    return describe(wiring.config, wiring.name), failure


def service_description(
    cell: str, wiring: ServiceWiring, running: RunningCell | None, parameters: list[Parameter]
) -> dict[str, Any]:
    """Return all that is known of a service as JSON."""
    state = "ready" if running is not None and wiring.name in running.ready else "not running"
    status = ServiceStatus(name=wiring.name, state="stopped")
    for each in running.status.services if running and running.status else []:
        if each.name == wiring.name:
            status, state = each, each.state
    return {
        "cell": cell, "service": wiring.name, "doc": wiring.doc, "state": state, "pid": status.pid,
        "restarts": status.restarts, "ready_seconds": status.ready_seconds,
        **{side: getattr(wiring, side) for side in SIDES},
        "parameters": [each.model_dump() for each in parameters],
    }


def service_lines(description: dict[str, Any], topics: Mapping[str, AnyTopic]) -> Iterator[str]:
    """Yield a description as lines of text."""
    yield f"{description['cell']}/{description['service']}: {description['doc']}"
    yield f"state: {description['state']}" + (
        f", pid {description['pid']}, {description['restarts']} restarts" if description["pid"] else ""
    )
    for side in SIDES:
        yield f"{side}:" if description[side] else f"{side}: nothing"
        for key in description[side]:
            topic = topics.get(key)
            answer = getattr(topic, "answer", None)
            carries = f"{topic.kind:<8} {topic.message.__name__}" if topic else ""
            yield f"  {key:<28} {carries}{f' -> {answer.__name__}' if answer else ''}".rstrip()
    yield "parameters:" if description["parameters"] else "parameters: none"
    for each in description["parameters"]:
        yield f"  {_parameter_line(each)}"


def _parameter_line(each: dict[str, Any]) -> str:
    low, high = each["minimum"], each["maximum"]
    bounds = " to ".join(f"{value:g}" for value in (low, high) if value is not None)
    if (low is None) != (high is None):
        bounds = f">= {bounds}" if high is None else f"<= {bounds}"
    about = "; ".join(part for part in (each["description"], ", ".join(each["choices"]) or bounds,
                                        "at run time" if each["runtime"] else "") if part)
    return f"{each['path']} = {json.dumps(each['value'])}" + (f"  # {about}" if about else "")
