"""Topics: what there is, what it carries, what comes, how often, how late, and sending by hand."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import choices as offers
from cli import options, publishing
from cli.target import RUNNING, CellTarget, CommandGroup
from common import terminal

if TYPE_CHECKING:
    from common.client.keys import Known
    from common.topics import Topic
    from common.transport.bus import Bus

app = CommandGroup("Topics: what there is, what it carries, what comes and how often.")

AnyKey = Annotated[
    str, typer.Argument(metavar="KEY", help="as in `zencell topic list`", autocompletion=offers.keys)
]


@app.command("list")
def list_(at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """List all topics: key, kind, message, who writes or serves it in a cell, and what it is.

    Asked are the cells that are up; while there are none, those of the configuration.
    """
    for known in _known(at).values():
        topic = known.topic
        kind, message, doc = (topic.kind, topic.message.__name__, topic.doc) if topic else ("", "", "")
        if as_json:
            described = {"key": known.key, "kind": kind, "message": message, "writer": known.writer, "doc": doc}
            terminal.echo(json.dumps(described))
        else:
            terminal.echo(f"{known.key:<20} {kind:<8} {message:<17} {known.writer:<22} {doc}".rstrip())


def _known(at: CellTarget) -> dict[str, Known]:
    from common.client.keys import known_keys

    return known_keys(at.cell, at.domain, at.connect)


@app.command()
def info(key: AnyKey, at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Show what a topic carries, field by field; for a request also the answer and an example to call it with.

    Who writes or serves it is asked of the cells that are up; while there are none, of those of the configuration.
    """
    from common.client.keys import topic_of
    from common.client.telling import described, description
    from common.topics import general_key

    known = _known(at).get(general_key(key))
    topic = known.topic if known and known.topic and known.topic.key == key else topic_of(key)
    own = topic.key.partition("/")[2] if general_key(topic.key) != topic.key else ""
    writer = own or (known.writer if known else "")
    for line in [json.dumps(described(topic, writer))] if as_json else description(topic, writer):
        terminal.echo(line)


@app.command()
def echo(
    key: options.PublishedKey,
    at: CellTarget = RUNNING,
    count: options.Count = None,
    as_json: options.Json = False,
    save: Annotated[
        str, typer.Option("--save", metavar="FILE.png", help="keep the newest picture there")
    ] = "",
) -> None:
    """Show what comes, until Ctrl-C or N messages; pictures as one line. A key of your own services will do too."""
    from common.client.keys import published_or_foreign
    from common.client.telling import messages, require_pictures

    topic = published_or_foreign(key)
    if save:
        require_pictures(topic, key, save)
    _show(at, lambda bus: messages(bus, topic, key, as_json=as_json, save=save), topic, key, count)


def _show(
    at: CellTarget, lines: Callable[[Bus], AsyncGenerator[str, None]], topic: Topic[Any] | None, key: str,
    count: str | None,
) -> None:
    """Write lines about a topic, or about a foreign key when that is None.

    Raises:
        SilentKey: the key is foreign and no cell is up that could know it.
        NoCellRunning: no cell is up.
    """
    from common.client.foreign import SilentKey
    from common.client.joining import NoCellRunning

    try:
        at.show(lines, options.whole("--count", count, 1))
    except NoCellRunning as error:
        if topic is None:
            raise SilentKey(key, f"and there is {error}") from None
        raise


def _measured(kind: str, doc: str) -> None:
    """Add a verb that shows figures of a topic."""
    def verb(
        key: options.PublishedKey, at: CellTarget = RUNNING, count: options.Count = None, as_json: options.Json = False
    ) -> None:
        from common.client.keys import published_or_foreign
        from common.client.telling import figures

        topic = published_or_foreign(key)
        _show(at, lambda bus: figures(bus, topic, key, kind, as_json=as_json), topic, key, count)

    verb.__doc__ = doc
    app.command(kind)(verb)


_measured("hz", "Show how many messages come each second, until Ctrl-C or N lines.")
_measured("bw", "Show how many bytes come each second, until Ctrl-C or N lines.")
app.command()(publishing.pub)
_measured("delay", "Show how old messages are when they come, until Ctrl-C or N lines: wall time since the stamp in "
                   "the header.")
