"""Play a recording: publish its messages again, with or without a running cell."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli import options
from cli.recording import Exclude, File
from common.errors import ConfigError
from common.terminal import echo, rewrite

if TYPE_CHECKING:
    from recording.player import Player

MAX_RATE = 1000.0


def play_(
    file: File,
    keys: Annotated[list[str] | None, typer.Argument(metavar="KEY", help="only these; * and ** as wildcards")] = None,
    topics: Annotated[
        list[str] | None, typer.Option("--topics", metavar="KEY", help="only these: the same as naming them after FILE")
    ] = None,
    exclude: Exclude = None,
    remap: Annotated[
        list[str] | None, typer.Option("--remap", metavar="FROM:=TO", help="publish under another key; repeatable")
    ] = None,
    rate: Annotated[str, typer.Option("--rate", metavar="X", help="speed factor")] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="repeat until Ctrl-C")] = False,
    start_offset: Annotated[str, typer.Option("--start-offset", metavar="S", help="start at this time of the "
                                                                                  "recording [s]")] = "0",
    start_paused: Annotated[bool, typer.Option("--start-paused", help="wait for space at the start")] = False,
    stamp_now: Annotated[
        bool, typer.Option("--stamp-now", help="shift stamps to the present [stamps as recorded]")
    ] = False,
    wait: Annotated[
        list[str] | None, typer.Option("--wait", metavar="SERVICE", help="start once this service is ready; repeatable")
    ] = None,
    cell: Annotated[str | None, typer.Option("--cell", metavar="NAME", help="play as this cell")] = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Publish the messages of a recording with their timing; start a router if none is running.

    On a terminal space pauses, right steps one message, down one image, left goes back 5 s, q quits.
    """
    from common.remapping import is_cell
    from common.transport.credentials import require_open_cell
    from recording.player import play, played_topics, renaming
    from recording.reader import Recording
    from recording.selection import Selection

    require_open_cell("play")
    selection = Selection.of([*(keys or ()), *(topics or ())], None, exclude)
    renamed = renaming(remap or [])
    speed, offset = options.number("--rate", rate), options.number("--start-offset", start_offset)
    if not 0 < speed <= MAX_RATE:
        raise ConfigError("--rate", rate, f"must be more than 0 and at most {MAX_RATE:g}")
    on_terminal = sys.stdin.isatty() and sys.stderr.isatty()
    if start_paused and not on_terminal:
        raise ConfigError("--start-paused", ..., "needs a terminal, where space continues; --wait SERVICE needs none")
    with Recording(Path(file)) as recording:
        if not 0 <= offset <= recording.seconds:
            raise ConfigError("--start-offset", start_offset, f"must be 0 to {recording.seconds:.1f}, its length [s]")
        played = played_topics(recording, selection)
        if loop and recording.seconds == 0:
            raise ConfigError("--loop", ..., f"needs a recording with a length, but {file} has none")

        def create() -> Player:
            from recording.player import Player

            return Player(recording, selection.wants, renamed, rate=speed, offset=offset, loop=loop,
                          paused=start_paused, stamp_now=stamp_now)

        name = cell or recording.cell
        if not name:
            raise ConfigError("--cell", ..., f"{file} does not name its cell: name one")
        if not is_cell(name):
            raise ConfigError("--cell", name, "is not a valid name of a cell")
        show = rewrite if on_terminal else None
        code = asyncio.run(play(create, recording, played, name, wait or [], domain, connect, echo, show))
    raise typer.Exit(code)
