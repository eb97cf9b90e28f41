"""Frames: where one is in another, and the tree that they make."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.target import RUNNING, CellTarget, CommandGroup
from common import terminal

if TYPE_CHECKING:
    from common.transport.bus import Bus

app = CommandGroup("Frames: where one is in another, and the tree that they make.")

Rate = Annotated[str, typer.Option("--rate", metavar="HZ", help="lines per second")]
Once = Annotated[bool, typer.Option("--once", help="one line, then end")]


@app.command()
def echo(
    target: Annotated[str, typer.Argument(metavar="A", help="the frame to measure in, as in `zencell tf frames`")],
    source: Annotated[str, typer.Argument(metavar="B", help="the frame whose pose is wanted")],
    once: Once = False,
    rate: Rate = "1",
    count: options.Count = None,
    at: CellTarget = RUNNING,
    as_json: options.Json = False,
) -> None:
    """Show the pose of B in A: position, quaternion x y z w, and roll, pitch, yaw in degrees."""
    from common.client.frames import describe, poses

    period = 1 / options.rate(rate)
    most = 1 if once else options.whole("--count", count, 1)

    async def lines(bus: Bus) -> AsyncGenerator[str, None]:
        async for figures in poses(bus, target, source, period):
            yield json.dumps(figures) if as_json else describe(figures)

    at.show(lines, most)


@app.command()
def frames(at: CellTarget = RUNNING, as_json: options.Json = False) -> None:
    """Show the tree of frames, and which of them move."""
    from common.client.frames import Frames

    async def gathered(bus: Bus) -> Frames:
        async with Frames(bus) as found:
            await found.gather()
        return found

    found = at.visit(gathered)
    for depth, name in found.tree.walk():
        moves = name in found.moving
        if as_json:
            terminal.echo(json.dumps({"frame": name, "parent": found.tree.parent_of(name), "moves": moves}))
        else:
            terminal.echo(f"{'  ' * depth}{name}{'  (moves)' if moves else ''}")
