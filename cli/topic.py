"""`topic`: list, describe, show, measure and publish topics."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import choices, options
from cli.options import RUNNING, CellTarget, CommandGroup
from common import terminal
from common.errors import ConfigError

if TYPE_CHECKING:
    from common.client.keys import Known
    from common.topics import Topic
    from common.transport.bus import Bus

app = CommandGroup("List, show, measure and publish topics.")

AnyKey = Annotated[
    str, typer.Argument(metavar="KEY", help="a key of `zencell topic list`", autocompletion=choices.keys)
]


@app.command("list")
def list_(at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """List all topics: key, kind, message, the services that write or serve it, and a description.

    The services are those of the running cells; without any, those of the configured cells.
    """
    for known in _known(at).values():
        topic = known.topic
        kind, message, doc = (topic.kind, topic.message.__name__, topic.doc) if topic else ("", "", "")
        if as_json:
            listed = {"key": known.key, "kind": kind, "message": message, "writer": known.writer, "doc": doc}
            terminal.echo(json.dumps(listed))
        else:
            terminal.echo(f"{known.key:<20} {kind:<8} {message:<17} {known.writer:<22} {doc}".rstrip())


def _known(at: CellTarget) -> dict[str, Known]:
    from common.client.keys import known_keys

    return known_keys(at.cell, at.domain, at.connect)


@app.command()
def info(key: AnyKey, at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Describe the message of a topic field by field; for a request also the answer and an example.

    The writers are those of the running cells; without any, those of the configured cells.
    """
    from common.client.inspection import topic_description, topic_lines
    from common.client.keys import topic_of
    from common.topics import general_key

    known = _known(at).get(general_key(key))
    topic = known.topic if known and known.topic and known.topic.key == key else topic_of(key)
    service = topic.key.partition("/")[2] if general_key(topic.key) != topic.key else ""
    writer = service or (known.writer if known else "")
    for line in [json.dumps(topic_description(topic, writer))] if as_json else topic_lines(topic, writer):
        terminal.echo(line)


@app.command()
def echo(
    key: options.PublishedKey,
    at: CellTarget = RUNNING,
    count: options.Count = None,
    as_json: options.Json = False,
    save: Annotated[
        str, typer.Option("--save", metavar="FILE.png", help="save the newest image in this file")
    ] = "",
) -> None:
    """Show messages until Ctrl-C or N messages, images as one line. Keys of custom services work too."""
    from common.client.inspection import message_lines, require_images
    from common.client.keys import published_topic

    topic = published_topic(key)
    if save:
        require_images(topic, key, save)
    _show(at, lambda bus: message_lines(bus, topic, key, as_json, save), topic, key, count)


def _show(
    at: CellTarget, lines: Callable[[Bus], AsyncGenerator[str, None]], topic: Topic[Any] | None, key: str,
    count: str | None,
) -> None:
    """Write lines about a topic, or about an unknown key.

    Raises:
        SilentKey: the key is unknown and no cell is running that could know it.
        NoCellRunning: no cell is running.
    """
    from common.client.joining import NoCellRunning
    from common.client.keys import SilentKey

    try:
        at.show(lines, options.whole("--count", count, 1))
    except NoCellRunning as error:
        if topic is None:
            raise SilentKey(key, f"and there is {error}") from None
        raise


def _measured(kind: str, doc: str) -> None:
    """Add a command that shows statistics of a topic."""
    def command(
        key: options.PublishedKey, at: CellTarget = RUNNING, count: options.Count = None,
        as_json: options.Json = False,
    ) -> None:
        from common.client.keys import published_topic
        from common.client.statistics import watch_statistics

        topic = published_topic(key)

        async def lines(bus: Bus) -> AsyncGenerator[str, None]:
            expression = topic.expression if topic else key
            async with aclosing(watch_statistics(bus, expression, kind, known=topic is not None)) as found:
                async for figures, line in found:
                    yield json.dumps({"key": key, **figures}) if as_json else line

        _show(at, lines, topic, key, count)

    command.__doc__ = doc
    app.command(kind)(command)


_measured("hz", "Show messages per second, until Ctrl-C or N lines.")
_measured("bw", "Show bytes per second, until Ctrl-C or N lines.")


@app.command()
def pub(
    key: options.PublishedKey,
    body: Annotated[str, typer.Argument(metavar="JSON", help="fields of the message; see `zencell topic info KEY`")],
    rate: Annotated[str, typer.Option("--rate", "-r", metavar="HZ", help="messages per second")] = "1",
    once: Annotated[bool, typer.Option("--once", help="publish one message and exit")] = False,
    count: options.Count = None,
    at: CellTarget = RUNNING,
) -> None:
    """Publish a message until Ctrl-C, N times or once. A missing stamp is set to the cell time of each message.

    A state can be queried while this runs. Keys of custom services take any JSON; {"base64": "..."} encodes bytes.
    """
    from common.client.inspection import publish
    from common.client.joining import cell_clock
    from common.client.json_codec import message_from_json
    from common.client.keys import writers_of
    from common.topics import of_service
    from common.transport.credentials import require_open_cell

    require_open_cell("topic pub")
    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)
    topic = _publishable(key)
    message = message_from_json(topic, key, body)

    async def visit(bus: Bus) -> None:
        bus.clock = await cell_clock(bus)
        # A signed topic is published under the key of the service that the message names.
        written = of_service(topic, message.service) if topic is not None and topic.signed else topic
        full_key = written.key if written is not None else key
        if others := await writers_of(bus, [full_key]):
            names = ", ".join(name for name, _ in others)
            terminal.echo(f"zencell: {names} writes {full_key} too: readers get both", err=True)
        await publish(bus, written, full_key, message, period, most)

    at.visit(visit)


def _publishable(key: str) -> Topic[Any] | None:
    """Return the topic of a key, or None for an unknown one.

    Raises:
        ConfigError: it is a request.
        UnknownName: it is not a valid key, or has wildcards.
    """
    from common.application import find_topic
    from common.client.keys import require_key
    from common.topics import Topic

    topic = find_topic(key)
    if topic is None:
        require_key(key, several=False)
    if topic is None or isinstance(topic, Topic):
        return topic
    raise ConfigError("KEY", key, f"is a request, which is not published: zencell call {key} JSON")


_measured("delay", "Show the age of messages at arrival, until Ctrl-C or N lines: wall time since their stamp.")
