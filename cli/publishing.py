"""The verb that publishes by hand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import options
from cli.target import RUNNING, CellTarget
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.topics import Topic
    from common.transport.bus import Bus

DEFAULT_RATE = "1"  # [Hz]

Rate = Annotated[str, typer.Option("--rate", "-r", metavar="HZ", help="messages per second")]
Once = Annotated[bool, typer.Option("--once", help="one message, then end")]


def pub(
    key: options.PublishedKey,
    body: Annotated[str, typer.Argument(metavar="JSON", help="its fields; `zencell topic info KEY` shows them")],
    rate: Rate = DEFAULT_RATE,
    once: Once = False,
    count: options.Count = None,
    at: CellTarget = RUNNING,
) -> None:
    """Publish a message until Ctrl-C, N times or once; a stamp that is left out is the cell's time of each message.

    A state can be asked for while this runs. A key of your own services takes any JSON; {"base64": "..."} is bytes.
    """
    from common.client.publishing import checked, publish, writers_of
    from common.transport.credentials import require_open_cell

    require_open_cell("topic pub")
    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)
    topic = _publishable(key)
    message = checked(topic, key, body)

    async def visit(bus: Bus) -> None:
        from common.client.joining import cell_clock
        from common.topics import of_service

        bus.clock = await cell_clock(bus)
        # A signed one goes under the key of whoever it says that it is of.
        written = of_service(topic, message.service) if topic is not None and topic.signed else topic
        under = written.key if written is not None else key
        if others := await writers_of(bus, [under]):
            echo(f"zencell: {', '.join(name for name, _ in others)} writes {under} too: readers get both", err=True)
        await publish(bus, written, under, message, period, most)

    at.visit(visit)


def _publishable(key: str) -> Topic[Any] | None:
    """The topic of a key; None for one that is not ours.

    Raises:
        ConfigError: it is a request.
        UnknownName: it is no key, or stands for several.
    """
    from common.application import find_topic
    from common.client.foreign import require_key
    from common.topics import Topic

    topic = find_topic(key)
    if topic is None:
        require_key(key, several=False)
    if topic is None or isinstance(topic, Topic):
        return topic
    raise ConfigError("KEY", key, f"is a request, which is not published: zencell call {key} JSON")
