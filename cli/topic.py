"""Topics: what there is, what it carries, what comes and how often."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import options
from common.errors import UnknownName

if TYPE_CHECKING:
    from common.topics import AnyTopic, Topic
    from common.transport.bus import Bus

app = typer.Typer(help="Topics: what there is, what it carries, what comes and how often.", no_args_is_help=True)

Key = Annotated[str, typer.Argument(metavar="KEY", help="as in `zencell topic list`, without the cell")]


@app.command("list")
def list_(as_json: options.Json = False) -> None:
    """List all topics: key, kind, message, who writes or serves it, and what it is."""
    from common.topics import all_topics

    for topic in all_topics().values():
        if as_json:
            typer.echo(json.dumps({
                "key": topic.key, "kind": topic.kind, "message": topic.message.__name__, "writer": topic.writer,
                "doc": topic.doc,
            }))
        else:
            typer.echo(f"{topic.key:<20} {topic.kind:<8} {topic.message.__name__:<17} {topic.writer:<22} {topic.doc}")


@app.command()
def info(key: Key, as_json: options.Json = False) -> None:
    """Show what a topic carries, field by field; for a request also the answer and an example to call it with."""
    from cli.schema import example_of, fields_of

    topic = topic_of(key)
    answer = getattr(topic, "answer", None)
    if as_json:
        described: dict[str, Any] = {
            "key": topic.key, "kind": topic.kind, "writer": topic.writer, "doc": topic.doc,
            "message": topic.message.__name__, "schema": topic.message.model_json_schema(),
        }
        if answer:
            described |= {"answer": answer.__name__, "answer_schema": answer.model_json_schema()}
            described["example"] = example_of(topic.key, topic.message)
        typer.echo(json.dumps(described))
        return
    typer.echo(f"{topic.key}: {topic.doc}\nkind: {topic.kind}")
    typer.echo(f"{'served' if answer else 'written'} by: {topic.writer}")
    typer.echo(f"message: {topic.message.__name__}")
    for line in fields_of(topic.message):
        typer.echo(f"  {line}")
    if answer:
        typer.echo(f"answer: {answer.__name__}")
        for line in fields_of(answer):
            typer.echo(f"  {line}")
        typer.echo(f"example: zencell call {topic.key} '{json.dumps(example_of(topic.key, topic.message))}'")


@app.command()
def echo(
    key: Key,
    cell: options.CellName = None,
    count: options.Count = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show what comes, until Ctrl-C or N messages; pictures as one line."""
    from cli.inspection import inspect

    topic = published(key)
    most = options.whole("--count", count, 1)

    async def visit(bus: Bus) -> None:
        shown = 0
        async for message in bus.reader(topic):
            typer.echo(_shown(message.model_dump(), as_json))
            shown += 1
            if shown == most:
                return

    inspect(visit, cell=cell, domain=domain, connect=connect)


def _shown(message: dict[str, Any], as_json: bool) -> str:
    from cli.rendering import one_line, to_json

    return to_json(message) if as_json else one_line(message)


@app.command()
def hz(
    key: Key,
    cell: options.CellName = None,
    count: options.Count = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show how many messages come each second, until Ctrl-C or N lines."""
    _measure(published(key), cell, count, as_json, domain, connect, in_bytes=False)


@app.command()
def bw(
    key: Key,
    cell: options.CellName = None,
    count: options.Count = None,
    as_json: options.Json = False,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Show how many bytes come each second, until Ctrl-C or N lines."""
    _measure(published(key), cell, count, as_json, domain, connect, in_bytes=True)


def _measure(
    topic: Topic[Any], cell: str | None, count: str | None, as_json: bool, domain: str | None, connect: str | None,
    *, in_bytes: bool,
) -> None:
    from cli.inspection import inspect
    from cli.measuring import describe, windows

    most = options.whole("--count", count, 1)

    async def visit(bus: Bus) -> None:
        shown = 0
        async for figures in windows(bus, f"{bus.cell}/{topic.key}"):
            typer.echo(json.dumps({"key": topic.key, **figures}) if as_json else describe(figures, in_bytes=in_bytes))
            shown += 1
            if shown == most:
                return

    inspect(visit, cell=cell, domain=domain, connect=connect)


def topic_of(key: str) -> AnyTopic:
    """The topic or request of a key.

    Raises:
        UnknownName: with the keys that there are.
    """
    from common.topics import all_topics

    topics = all_topics()
    if key not in topics:
        raise UnknownName("key", key, topics)
    return topics[key]


def published(key: str) -> Topic[Any]:
    """The topic of a key that is published.

    Raises:
        UnknownName: with the keys that are.
    """
    from common.topics import Topic, all_topics

    topic = topic_of(key)
    if not isinstance(topic, Topic):
        raise UnknownName("published key", key, [k for k, t in all_topics().items() if isinstance(t, Topic)])
    return topic
