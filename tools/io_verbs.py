"""`zencell io`: list, set and watch the inputs and outputs of a running cell."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING, Annotated

import typer

from common.errors import ConfigError
from common.terminal import echo
from common.verbs import Verbs
from tools.joining import join

if TYPE_CHECKING:
    from common.client.cell import Cell
    from common.messages import IoSignal, IoState


def _line(state: IoState, signal: IoSignal, width: int) -> str:
    from common.client.io import format_value

    problem = state.problem(signal.name)
    value = format_value(signal.value, signal.unit)
    return f"{signal.name:<{width}}  {signal.direction:<6}  {value:<10}  {problem}".rstrip()


def list_(cell: str | None = None, domain: str | None = None, connect: str | None = None) -> None:
    """List all signals: direction, value, and why one cannot be read."""
    state = join(lambda joined: joined.io.state(), cell, domain, connect)
    width = max((len(signal.name) for signal in state.signals), default=0)
    for signal in state.signals:
        echo(_line(state, signal, width))


def set_(
    signal: Annotated[str, typer.Argument(metavar="SIGNAL", help="name of an output")],
    value: Annotated[str, typer.Argument(metavar="VALUE", help="on, off, or a number")],
    cell: str | None = None, domain: str | None = None, connect: str | None = None,
) -> None:
    """Set an output; refused while the robot is stopped or another client has motion authority."""
    from common.client.io import format_value, parse_value

    wanted = parse_value(signal, value)
    reply = join(lambda joined: joined.io.set(signal, wanted), cell, domain, connect)
    echo(f"{reply.signal} is {format_value(reply.value)}")


def watch(
    signals: Annotated[list[str] | None, typer.Argument(metavar="[SIGNAL]...", help="all if none is given")] = None,
    count: Annotated[str | None, typer.Option("--count", "-n", metavar="N", help="exit after N lines")] = None,
    cell: str | None = None, domain: str | None = None, connect: str | None = None,
) -> None:
    """Print each change of a signal until Ctrl-C, first the present values."""
    most = None
    if count is not None and not ((most := int(count) if count.isdecimal() else 0) > 0):
        raise ConfigError("--count", count, "must be a whole number from 1")

    async def visit(joined: Cell) -> None:
        from common.client.io import signals_of

        state = await joined.io.state()
        names = signals or [signal.name for signal in state.signals]
        for name in names:
            signals_of(state).find(name)
        shown: dict[str, str] = {}
        printed = 0
        async with aclosing(aiter(joined.io)) as states:
            while True:
                for name in names:
                    if (found := state.find(name)) is not None and shown.get(name) != (
                            line := _line(state, found, max(map(len, names)))):
                        shown[name] = line
                        echo(line)
                        if (printed := printed + 1) == most:
                            return
                state = await anext(states)

    join(visit, cell, domain, connect)


VERBS = Verbs(commands={"io list": list_, "io set": set_, "io watch": watch},
              groups={"io": "List, set and watch digital and analog inputs and outputs."})
