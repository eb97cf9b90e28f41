"""`topic` and `tf`: list, describe, show, measure and publish topics; poses of coordinate frames."""

from __future__ import annotations

import asyncio
import json
import math
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
    from common.robot.transform_tree import TransformTree
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
    timeout: Annotated[
        str, typer.Option("--timeout", metavar="S", help="exit 1 after this time without a message [s; no limit]")
    ] = "",
    save: Annotated[
        str, typer.Option("--save", metavar="FILE.png", help="save the newest image in this file")
    ] = "",
) -> None:
    """Show messages until Ctrl-C or N messages, images as one line. Keys of custom services work too."""
    from common.client.inspection import message_lines, noting_silence, require_images
    from common.client.keys import published_topic

    topic = published_topic(key)
    if save:
        require_images(topic, key, save)
    seconds = options.number("--timeout", timeout) if timeout else None
    if seconds is not None and seconds <= 0:
        raise ConfigError("--timeout", timeout, "must be more than 0")
    _show(at, lambda bus: noting_silence(
        bus, message_lines(bus, topic, key, as_json, save), topic.key if topic is not None and not topic.signed else "",
        seconds, lambda line: terminal.echo(line, err=True)), topic, key, count)


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


tf = CommandGroup("Show poses of coordinate frames, and the tree of frames.")


@tf.command("echo")
def echo_pose(
    target: Annotated[str, typer.Argument(metavar="A", help="reference frame, one of `zencell tf frames`")],
    source: Annotated[str, typer.Argument(metavar="B", help="frame whose pose is shown")],
    once: Annotated[bool, typer.Option("--once", help="print one line and exit")] = False,
    rate: Annotated[str, typer.Option("--rate", metavar="HZ", help="lines per second")] = "1",
    count: options.Count = None,
    at: CellTarget = RUNNING,
    as_json: options.Json = False,
) -> None:
    """Show the pose of B in A: position, quaternion x y z w, and roll, pitch, yaw in degrees."""
    from common.client.frames import Frames

    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)

    async def lines(bus: Bus) -> AsyncGenerator[str, None]:
        async with Frames(bus) as frames:
            await frames.until_known(target, source)
            while True:
                frames.require_recent(target, source)
                figures = pose_figures(frames.tree, target, source)
                yield json.dumps(figures) if as_json else pose_line(figures)
                await asyncio.sleep(period)

    at.show(lines, most)


def pose_figures(tree: TransformTree, target: str, source: str) -> dict[str, Any]:
    """Return the pose of source in target as JSON: position [m], quaternion x, y, z, w, rpy [deg], stamp [ns]."""
    from common.robot.transforms import matrix_to_quaternion, matrix_to_rpy

    T = tree.pose(target, source)
    stamp = max(map(tree.stamp_of, tree.path(target, source)))  # of the newest transform on the path
    return {
        "target": target, "source": source, "stamp": stamp,
        "position": [round(float(value), 6) + 0.0 for value in T[:3, 3]],
        "quaternion": [round(value, 6) + 0.0 for value in matrix_to_quaternion(T[:3, :3])],
        "rpy_degrees": [round(math.degrees(value), 3) + 0.0 for value in matrix_to_rpy(T[:3, :3])],
    }


def pose_line(figures: dict[str, Any]) -> str:
    """Return a pose as a line of text."""

    def listed(values: list[float], digits: int) -> str:
        return " ".join(f"{round(value, digits) + 0.0:.{digits}f}" for value in values)

    return (
        f"{figures['source']} in {figures['target']}: position {listed(figures['position'], 4)} m, "
        f"quaternion {listed(figures['quaternion'], 4)}, rpy {listed(figures['rpy_degrees'], 2)} deg"
    )


@tf.command()
def frames(at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Show the tree of frames, and which of them move."""
    from common.client.frames import Frames

    async def gather(bus: Bus) -> Frames:
        async with Frames(bus) as found:
            await found.gather()
        return found

    found = at.visit(gather)
    for depth, name in found.tree.walk():
        moves = name in found.moving
        if as_json:
            terminal.echo(json.dumps({"frame": name, "parent": found.tree.parent_of(name), "moves": moves}))
        else:
            terminal.echo(f"{'  ' * depth}{name}{'  (moves)' if moves else ''}")
