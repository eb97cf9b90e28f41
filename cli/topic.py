"""Topics: what there is, what it carries, what comes, how often, how late, and sending by hand."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import completion, options, publishing
from common import terminal
from common.client import delay
from common.errors import ConfigError, UnknownName

if TYPE_CHECKING:
    from common.topics import AnyTopic, Topic
    from common.transport.bus import Bus

app = typer.Typer(help="Topics: what there is, what it carries, what comes and how often.", no_args_is_help=True)

AnyKey = Annotated[
    str, typer.Argument(metavar="KEY", help="as in `zencell topic list`", autocompletion=completion.keys)
]


@app.command("list")
def list_(
    cell: options.CellName = None, as_json: options.Json = False, domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """List all topics: key, kind, message, who writes or serves it in a cell, and what it is.

    Asked are the cells that are up; while there are none, those of the configuration.
    """
    from cli.owners import known_keys

    for known in known_keys(cell, domain, connect).values():
        topic = known.topic
        kind, message, doc = (topic.kind, topic.message.__name__, topic.doc) if topic else ("", "", "")
        if as_json:
            described = {"key": known.key, "kind": kind, "message": message, "writer": known.writer, "doc": doc}
            terminal.echo(json.dumps(described))
        else:
            terminal.echo(f"{known.key:<20} {kind:<8} {message:<17} {known.writer:<22} {doc}".rstrip())


@app.command()
def info(
    key: AnyKey, cell: options.CellName = None, as_json: options.Json = False, domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show what a topic carries, field by field; for a request also the answer and an example to call it with.

    Who writes or serves it is asked of the cells that are up; while there are none, of those of the configuration.
    """
    from cli.owners import known_keys
    from common.messages.schema import example_of, fields_of
    from common.topics import general_key

    known = known_keys(cell, domain, connect).get(general_key(key))
    topic = known.topic if known and known.topic and known.topic.key == key else topic_of(key)
    own = topic.key.partition("/")[2] if general_key(topic.key) != topic.key else ""
    writer = own or (known.writer if known else "")
    answer = getattr(topic, "answer", None)
    if as_json:
        described: dict[str, Any] = {
            "key": topic.key, "kind": topic.kind, "writer": writer, "doc": topic.doc,
            "message": topic.message.__name__, "schema": topic.message.model_json_schema(),
        }
        if answer:
            described |= {"answer": answer.__name__, "answer_schema": answer.model_json_schema()}
            described["example"] = example_of(topic.message)
        terminal.echo(json.dumps(described))
        return
    terminal.echo(f"{topic.key}: {topic.doc}\nkind: {topic.kind}")
    terminal.echo(f"{'served' if answer else 'written'} by: {writer or 'nobody here'}")
    terminal.echo(f"message: {topic.message.__name__}")
    for line in fields_of(topic.message):
        terminal.echo(f"  {line}")
    if answer:
        terminal.echo(f"answer: {answer.__name__}")
        for line in fields_of(answer):
            terminal.echo(f"  {line}")
        terminal.echo(f"example: zencell call {topic.key} '{json.dumps(example_of(topic.message))}'")


@app.command()
def echo(
    key: options.PublishedKey,
    cell: options.CellName = None,
    count: options.Count = None,
    as_json: options.Json = False,
    save: Annotated[
        str, typer.Option("--save", metavar="FILE.png", help="keep the newest picture there")
    ] = "",
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show what comes, until Ctrl-C or N messages; pictures as one line. A key of your own services will do too."""
    most = options.whole("--count", count, 1)
    topic = published_or_foreign(key)
    if save:
        require_pictures(topic, key, save)

    async def visit(bus: Bus) -> None:
        from common.client.hearing import topic_in
        from common.topics import Topic

        shown = 0
        found = topic or await topic_in(bus, key)
        if save and found is None:
            raise ConfigError("--save", save, f"is for pictures: nobody says what {key} carries")
        if save:
            require_pictures(found, key, save)
        lines = _messages(bus, found, as_json, save) if isinstance(found, Topic) else _foreign_messages(
            bus, key, as_json)
        async with aclosing(lines):
            async for line in lines:
                terminal.echo(line)
                shown += 1
                if shown == most:
                    return

    visit_topic(visit, topic, key, cell, domain, connect)


def require_pictures(topic: AnyTopic | None, key: str, save: str) -> None:
    """Return when pictures of a topic, if that is known, can be kept in a file of that name.

    Raises:
        ConfigError: they cannot.
    """
    if not save.lower().endswith(".png") or not Path(save).parent.is_dir():
        raise ConfigError("--save", save, "must be the name of a .png file in a folder that is there")
    if topic is not None and topic.message.__name__ != "Image":
        raise ConfigError("--save", save, f"is for pictures: {key} carries {topic.message.__name__}")


async def _messages(bus: Bus, topic: Topic[Any], as_json: bool, save: str = "") -> AsyncGenerator[str, None]:
    from common.messages.schema import one_line, to_json

    async for message in bus.reader(topic):
        if save:
            from common.recording.pictures import save_picture

            await asyncio.to_thread(save_picture, message, Path(save))
        yield to_json(message.model_dump()) if as_json else one_line(message.model_dump())


async def _foreign_messages(bus: Bus, key: str, as_json: bool) -> AsyncGenerator[str, None]:
    import msgpack

    from common.client.foreign import samples
    from common.client.zenoh_codec import decode
    from common.messages.schema import to_json

    async with aclosing(samples(bus, key)) as coming:
        async for sample in coming:
            line = decode(sample.key, sample.payload)
            whole = as_json and not line.startswith("<")  # what is no message has no other form
            yield to_json(msgpack.unpackb(sample.payload, raw=False, strict_map_key=False)) if whole else line


def visit_topic(
    visit: Callable[[Bus], Awaitable[None]], topic: Topic[Any] | None, key: str, cell: str | None,
    domain: str | None, connect: str | None,
) -> None:
    """Visit the cell for a topic, or for a foreign key when that is None.

    Raises:
        SilentKey: the key is foreign and no cell is up that could know it.
        NothingUp: no cell is up.
    """
    from cli.inspection import inspect
    from common.client.foreign import SilentKey
    from common.client.joining import NothingUp

    try:
        inspect(visit, cell=cell, domain=domain, connect=connect)
    except NothingUp as error:
        if topic is None:
            raise SilentKey(key, f"and there is {error}") from None
        raise


def _measured(name: str, doc: str, visiting: Callable[[Bus, str, bool], AsyncGenerator[tuple[Any, str], None]]) -> None:
    """Add a verb that shows figures of a topic, each as a mapping and as a line for people.

    Args:
        name: of the verb.
        doc: what it shows.
        visiting: yields the figures, given a bus in the cell, the key, and whether it is none of the project's.
    """
    def verb(
        key: options.PublishedKey, cell: options.CellName = None, count: options.Count = None,
        as_json: options.Json = False, domain: options.Domain = None, connect: options.Connect = None,
    ) -> None:
        most = options.whole("--count", count, 1)
        topic = published_or_foreign(key)

        async def visit(bus: Bus) -> None:
            shown = 0
            async for figures, line in visiting(bus, topic.expression if topic else key, topic is None):
                terminal.echo(json.dumps({"key": key, **figures}) if as_json else line)
                shown += 1
                if shown == most:
                    return

        visit_topic(visit, topic, key, cell, domain, connect)

    verb.__doc__ = doc
    app.command(name)(verb)


async def _rates(bus: Bus, key: str, foreign: bool, *, in_bytes: bool) -> AsyncGenerator[tuple[Any, str], None]:
    from common.client.foreign import require_heard
    from common.client.measuring import describe, windows

    if foreign:
        await require_heard(bus, key)
    async for figures in windows(bus, f"{bus.cell}/{key}"):
        yield figures, describe(figures, in_bytes=in_bytes)


_measured("hz", "Show how many messages come each second, until Ctrl-C or N lines.", partial(_rates, in_bytes=False))
_measured("bw", "Show how many bytes come each second, until Ctrl-C or N lines.", partial(_rates, in_bytes=True))
app.command()(publishing.pub)
_measured("delay", "Show how old messages are when they come, until Ctrl-C or N lines: wall time since the stamp in "
                   "the header.", delay.delays)


def topic_of(key: str) -> AnyTopic:
    """The topic or request of a key.

    Raises:
        UnknownName: with the keys that there are.
    """
    from common.application import all_topics, find_topic

    topic = find_topic(key)
    if topic is None:
        raise UnknownName("key", key, all_topics())
    return topic


def published(key: str) -> Topic[Any]:
    """The topic of a key that is published.

    Raises:
        UnknownName: with the keys that are.
    """
    from common.application import all_topics
    from common.topics import Topic

    topic = topic_of(key)
    if not isinstance(topic, Topic):
        raise UnknownName("published key", key, [k for k, t in all_topics().items() if isinstance(t, Topic)])
    return topic


def published_or_foreign(key: str) -> Topic[Any] | None:
    """The topic of a key that is published; None for a key of somebody else's.

    Raises:
        UnknownName: with the keys that are published, for one that is requested.
    """
    from common.application import find_topic

    return published(key) if find_topic(key) else None
