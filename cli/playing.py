"""Play a recording: what was recorded travels again, with or without the cell that it came from."""

from __future__ import annotations

import asyncio
import os
import re
import socket
import sys
import termios
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli import options
from cli.recording import Exclude, File
from common.errors import ConfigError
from common.terminal import echo

if TYPE_CHECKING:
    from common.client.player import Player
    from common.recording.reading import Recording
    from common.recording.selection import Selection
    from common.transport.bus import Bus

Topics = dict[str, tuple[str, str]]  # message class and kind by topic

TOOL = "player"
SHOW_PERIOD = 0.2  # [s]
PROBE_TIMEOUT = 0.5  # [s]
LINGER = 2.0  # [s] that a router of our own stays for who listens: what they make of the last message travels over it
CLOSE = 0.5  # [s] that its end may take
MOST_RATE = 1000.0
HELP = "space pauses, right steps a message, down a picture, left goes back 5 s, q quits"


def play(
    file: File,
    keys: Annotated[list[str] | None, typer.Argument(metavar="KEY", help="only these; * and ** as wildcards")] = None,
    topics: Annotated[
        list[str] | None, typer.Option("--topics", metavar="KEY", help="only these: the same as naming them after FILE")
    ] = None,
    exclude: Exclude = None,
    remap: Annotated[
        list[str] | None, typer.Option("--remap", metavar="FROM:=TO", help="publish under another key; repeatable")
    ] = None,
    rate: Annotated[str, typer.Option("--rate", metavar="X", help="times as fast")] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="begin again at the end, until Ctrl-C")] = False,
    start_offset: Annotated[str, typer.Option("--start-offset", metavar="S", help="begin there [s]")] = "0",
    start_paused: Annotated[bool, typer.Option("--start-paused", help="wait for space at the start")] = False,
    stamp_now: Annotated[
        bool, typer.Option("--stamp-now", help="move stamps to the present; else they stay as recorded")
    ] = False,
    wait: Annotated[
        list[str] | None, typer.Option("--wait", metavar="SERVICE", help="begin when it is ready; repeatable")
    ] = None,
    cell: Annotated[str | None, typer.Option("--cell", metavar="NAME", help="play as this cell")] = None,
    domain: options.Domain = None,
    connect: options.Connect = None,
) -> None:
    """Publish what was recorded, in its own time; starts a router if none is there.

    On a terminal space pauses, right steps one message, down one picture, left goes back 5 s, q quits.
    """
    from common.recording.reading import Recording
    from common.recording.selection import Selection
    from common.transport.credentials import refuse_to_publish

    refuse_to_publish("play")
    selection = Selection.of([*(keys or ()), *(topics or ())], None, exclude)
    renamed = _renaming(remap or [])
    speed, offset = options.number("--rate", rate), options.number("--start-offset", start_offset)
    if not 0 < speed <= MOST_RATE:
        raise ConfigError("--rate", rate, f"must be more than 0 and at most {MOST_RATE:g}")
    if start_paused and not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ConfigError("--start-paused", ..., "needs a terminal, where space goes on; --wait SERVICE needs none")
    with Recording(Path(file)) as recording:
        if not 0 <= offset <= recording.seconds:
            raise ConfigError("--start-offset", start_offset, f"must be 0 to {recording.seconds:.1f}, its length [s]")
        played = _played(recording, selection)
        if loop and recording.seconds == 0:
            raise ConfigError("--loop", ..., f"needs a recording with a length, which {file} has not")

        def make() -> Player:
            from common.client.player import Player

            return Player(recording, selection.wants, renamed, rate=speed, offset=offset, loop=loop,
                          paused=start_paused, stamp_now=stamp_now)

        name = cell or recording.cell
        if not name:
            raise ConfigError("--cell", ..., f"{file} does not say of which cell it is: name one")
        code = asyncio.run(_play(make, recording, played, name, wait or [], domain, connect))
    raise typer.Exit(code)


def _renaming(pairs: list[str]) -> Callable[[str], str]:
    """What maps a topic to the one under which it is published.

    Raises:
        ConfigError: a pair is none.
    """
    table: dict[str, str] = {}
    for pair in pairs:
        if not (match := re.fullmatch(r"([^:=#?*$]+):=([^:=#?*$]+)", pair)) or any(
            part.startswith("/") or part.endswith("/") or "//" in part for part in match.groups()
        ):
            raise ConfigError("--remap", pair, "must be FROM:=TO, such as camera/image_raw:=test/image")
        table[match[1]] = match[2]
    return lambda topic: table.get(topic, topic)


def _played(recording: Recording, selection: Selection) -> Topics:
    """The topics that are played, with message class and kind.

    Raises:
        ConfigError: one is not in the recording, or there is none.
        RecordingError: one is no key.
    """
    from common.recording.sample import RecordingError
    from common.recording.selection import covers
    from common.remapping import is_key

    every = recording.topics()
    for key in selection.keys:
        if "*" not in key and not any(covers(key, topic) for topic in every):
            raise ConfigError("KEY", key, f"is not in {recording.path}; choices: {', '.join(sorted(every)) or 'none'}")
    wanted = {topic: what for topic, what in every.items() if selection.wants(topic)}
    for topic in wanted:
        if not is_key(topic):
            raise RecordingError(f"{recording.path}: has messages of {topic[:60]!r}, which is no key to publish under")
    if not wanted:
        raise ConfigError(str(recording.path), ..., "has no message that is to be played")
    return wanted


async def _play(
    make: Callable[[], Player], recording: Recording, played: Topics, cell: str, wait: list[str],
    domain: str | None, connect: str | None,
) -> int:
    from cli.playing import Keys
    from common.clock import Clock
    from common.supervision.interrupts import Interrupts
    from common.transport.connect import connect as connect_to
    from common.transport.endpoint import endpoint_of

    interrupts = Interrupts()
    interrupts.install()
    endpoint = endpoint_of(domain, connect)
    async with (
        _router(endpoint, may_start=connect is None) as own,
        connect_to(cell=cell, service=TOOL, endpoint=endpoint, clock=Clock.from_environment()) as bus,
    ):
        player = make()
        player.declare(bus, played)
        with Keys(player.on_key) as terminal:
            playing = asyncio.create_task(_wait_and_run(player, bus, wait))
            showing = asyncio.create_task(_show(player, recording)) if terminal.on_terminal else None
            stopped = asyncio.create_task(interrupts.stop.wait())
            _greet(player, recording, cell, endpoint, own=own, live=showing is not None)
            await _warn_of_others(bus, [player.renamed(topic) for topic in played])
            try:
                await asyncio.wait({playing, stopped}, return_when=asyncio.FIRST_COMPLETED)
                if playing.done():
                    playing.result()
            finally:
                for task in (playing, stopped, showing):
                    if task is not None:
                        task.cancel()
                await asyncio.gather(*(t for t in (playing, stopped, showing) if t), return_exceptions=True)
                if terminal.on_terminal:
                    sys.stderr.write("\r\x1b[K")
                    sys.stderr.flush()
        echo(f"played {player.published:,} messages")
        if own and player.heard:
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER):
                    await interrupts.stop.wait()
    return 128 + interrupts.signal if interrupts.signal else 0


@asynccontextmanager
async def _router(endpoint: str, *, may_start: bool) -> AsyncIterator[bool]:
    """A router at the endpoint during the block; whether it is our own."""
    from common.transport.router import open_router
    from common.transport.zenoh_session import close_bounded

    if not may_start or await asyncio.to_thread(_listens, endpoint):
        yield False
        return
    session = await asyncio.to_thread(open_router, [endpoint])
    try:
        yield True
    finally:
        await close_bounded(session, CLOSE)


def _listens(endpoint: str) -> bool:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with socket.socket() as probe:
        probe.settimeout(PROBE_TIMEOUT)
        return probe.connect_ex((host, int(port))) == 0


async def _wait_and_run(player: Player, bus: Bus, wait: list[str]) -> None:
    for name in wait:
        await bus.alive.wait(name)
    await player.run()


def _greet(player: Player, recording: Recording, cell: str, endpoint: str, *, own: bool, live: bool) -> None:
    where = f"{endpoint}{', a router of its own' if own else ''}"
    echo(f"playing {recording.path} ({recording.seconds:.1f} s) as {cell} at {where}")
    if live:
        echo(HELP)
    if not recording.finished:
        echo(f"it is not finished; zencell recover {recording.path} makes it whole", err=True)


async def _warn_of_others(bus: Bus, played: list[str]) -> None:
    """Say which services that are up write what is played too."""
    owners = await bus.owners()
    for topic in played:
        for name in [owner.service for owner in owners if owner.key == topic]:
            echo(f"{name} is up and writes {topic} too: whoever reads it hears both", err=True)


async def _show(player: Player, recording: Recording) -> None:
    while True:
        state = "paused" if player.head.paused else f"x{player.head.rate:g}"
        line = f"{player.position:7.1f} / {recording.seconds:.1f} s  {state}  {player.published:,} messages"
        sys.stderr.write(f"\r\x1b[K{line}")
        sys.stderr.flush()
        await asyncio.sleep(SHOW_PERIOD)


NAMES = {b"\x1b[C": "right", b"\x1b[D": "left", b"\x1b[B": "down", b"\x1b[A": "up", b" ": "space"}


class Keys:
    """Calls back with the name of each key while the block runs; does nothing without a terminal.

    The terminal is as before when the block ends, however it ends. Ctrl-C stays a signal.
    """

    def __init__(self, on_key: Callable[[str], None]) -> None:
        """Take the terminal over only in the block; on the running loop."""
        self.on_terminal = sys.stdin.isatty() and sys.stderr.isatty()
        self._on_key = on_key
        self._before: list[Any] | None = None

    def __enter__(self) -> Keys:
        if self.on_terminal:
            self._before = termios.tcgetattr(sys.stdin.fileno())
            tty.setcbreak(sys.stdin.fileno())
            asyncio.get_running_loop().add_reader(sys.stdin.fileno(), self._read)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
            termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._before)

    def _read(self) -> None:
        data = os.read(sys.stdin.fileno(), 64)
        if not data:  # the terminal is gone
            asyncio.get_running_loop().remove_reader(sys.stdin.fileno())
        for name in names_of(data):
            self._on_key(name)


def names_of(data: bytes) -> list[str]:
    """Names of the keys that the terminal's bytes stand for: right, left, up, down, space, or a letter."""
    names = []
    while data:
        known = next((code for code in NAMES if data.startswith(code)), None)
        if known is not None:
            names.append(NAMES[known])
        elif data[0] != 0x1B:
            names.append(chr(data[0]))
        else:  # another sequence, or Escape alone: a letter of it must not be taken for a key
            break
        data = data[len(known) if known else 1 :]
    return names
