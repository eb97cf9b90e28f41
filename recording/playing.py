"""Plays a recording to a cell, or to a router of its own, while a person at the keys may say otherwise."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Callable
from typing import Protocol

from common.client.joining import is_listening
from common.client.publishing import writers_of
from common.clock import Clock
from common.errors import ConfigError
from common.remapping import is_key
from common.supervision.lifecycle import Interrupts
from common.transport.bus import Bus
from common.transport.connect import connect as connect_to
from common.transport.endpoint import endpoint_of
from common.transport.router import open_router
from common.transport.zenoh_session import close_bounded
from recording.keyboard import Keys
from recording.player import Player
from recording.reading import Recording
from recording.sample import RecordingError
from recording.selection import Selection

TOOL = "player"
SHOW_PERIOD = 0.2  # [s]
LINGER = 2.0  # [s] that a router of our own stays for who listens: what they make of the last message travels over it
CLOSE = 0.5  # [s] that its end may take
HELP = "space pauses, right steps a message, down a picture, left goes back 5 s, q quits"


class Tell(Protocol):
    """Is called with lines for a person; those about what is not well go to stderr."""

    def __call__(self, text: str, *, err: bool = False) -> None:
        """Show a line."""


def renaming(pairs: list[str]) -> Callable[[str], str]:
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


def played_of(recording: Recording, selection: Selection) -> dict[str, tuple[str, str]]:
    """The topics that are played, with message class and kind.

    Raises:
        ConfigError: one is not in the recording, or there is none.
        RecordingError: one is no key.
    """
    every = recording.topics()
    selection.require_in(every, recording.path, "KEY")
    wanted = {topic: what for topic, what in every.items() if selection.wants(topic)}
    for topic in wanted:
        if not is_key(topic):
            raise RecordingError(f"{recording.path}: has messages of {topic[:60]!r}, which is no key to publish under")
    if not wanted:
        raise ConfigError(str(recording.path), ..., "has no message that is to be played")
    return wanted


async def play(
    make: Callable[[], Player], recording: Recording, played: dict[str, tuple[str, str]], cell: str, wait: list[str],
    domain: str | None, connect: str | None, tell: Tell, show: Callable[[str], None] | None,
) -> int:
    """Exit code of playing a recording to its end, or until a signal or key.

    Args:
        make: the player; called on the running loop.
        recording: that is played.
        played: message class and kind of its topics that are played.
        cell: as which it is played.
        wait: services that must be ready before.
        domain: where, as given to `--domain`; a router is started if none is there.
        connect: where, as given to `--connect`; none is started.
        tell: is called with lines for a person.
        show: is called with a line that takes the place of the one before; None where nobody is at the keys.
    """
    interrupts = Interrupts()
    interrupts.install()
    endpoint = endpoint_of(domain, connect)
    async with (
        _router(endpoint, may_start=connect is None) as own,
        connect_to(cell=cell, service=TOOL, endpoint=endpoint, clock=Clock.from_environment()) as bus,
    ):
        player = make()
        player.declare(bus, played)
        with Keys(player.on_key, on_terminal=show is not None):
            tasks = [asyncio.create_task(_wait_and_run(player, bus, wait)), asyncio.create_task(interrupts.stop.wait())]
            ending = set(tasks)
            if show:
                tasks.append(asyncio.create_task(_show(player, recording, show)))
            where = f"{endpoint}{', a router of its own' if own else ''}"
            tell(f"playing {recording.path} ({recording.seconds:.1f} s) as {cell} at {where}")
            if show:
                tell(HELP)
            if not recording.finished:
                tell(f"it is not finished; zencell recover {recording.path} makes it whole", err=True)
            for name, topic in await writers_of(bus, map(player.renamed, played)):
                tell(f"{name} is up and writes {topic} too: whoever reads it hears both", err=True)
            try:
                await asyncio.wait(ending, return_when=asyncio.FIRST_COMPLETED)
                if tasks[0].done():
                    tasks[0].result()
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                if show:
                    show("")
        tell(f"played {player.published:,} messages")
        if own and player.heard:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LINGER):
                    await interrupts.stop.wait()
    return 128 + interrupts.signal if interrupts.signal else 0


@contextlib.asynccontextmanager
async def _router(endpoint: str, *, may_start: bool) -> AsyncIterator[bool]:
    """A router at the endpoint during the block; whether it is our own."""
    if not may_start or await asyncio.to_thread(is_listening, endpoint):
        yield False
        return
    session = await asyncio.to_thread(open_router, [endpoint])
    try:
        yield True
    finally:
        await close_bounded(session, CLOSE)


async def _wait_and_run(player: Player, bus: Bus, wait: list[str]) -> None:
    for name in wait:
        await bus.alive.wait(name)
    await player.run()


async def _show(player: Player, recording: Recording, show: Callable[[str], None]) -> None:
    while True:
        state = "paused" if player.head.paused else f"x{player.head.rate:g}"
        show(f"{player.position:7.1f} / {recording.seconds:.1f} s  {state}  {player.published:,} messages")
        await asyncio.sleep(SHOW_PERIOD)
