"""Plays a recording: publishes its messages at their times, controlled by keys of the terminal."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Collection
from functools import cache
from typing import TYPE_CHECKING, Protocol

from common.application import all_topics
from common.client.joining import is_listening
from common.client.keys import writers_of
from common.clock import Clock
from common.errors import ConfigError
from common.remapping import is_key
from common.supervision.lifecycle import Interrupts
from common.topics import MOTION_EXECUTE, Topic
from common.transport.bus import Bus
from common.transport.endpoint import endpoint_of
from common.transport.router import open_router
from common.transport.zenoh_session import close_within
from common.transport.zenoh_session import connect as connect_to
from recording.keyboard import Keys
from recording.reader import Recording
from recording.sample import RecordingError, encoding_of, restamp
from recording.selection import Selection

if TYPE_CHECKING:
    from common.transport.writer import RawWriter
    from recording.sample import Sample

BACK = 5.0  # [s] of a jump back
IMAGE = "Image"
TOOL = "player"
SHOW_PERIOD = 0.2  # [s]
LINGER = 2.0  # [s] that the player's own router stays, so that subscribers can publish what the last message causes
CLOSE = 0.5  # [s] limit for closing it
HELP = "space: pause; right: next message; down: next image; left: back 5 s; q: quit"


class Playhead:
    """Position of a playback. Log times and the wall clock are both in ns since the Unix epoch."""

    def __init__(self, position: int, now: int, *, rate: float = 1.0, paused: bool = False) -> None:
        """Start at a log time.

        Args:
            position: the log time [ns].
            now: wall time [ns].
            rate: seconds of recording per second.
            paused: whether to wait for `resume`.
        """
        self.rate = rate
        self._position = position  # at _since
        self._since = now
        self._paused = paused

    @property
    def paused(self) -> bool:
        """Whether the playback waits for `resume`."""
        return self._paused

    def position(self, now: int) -> int:
        """Return the log time at a wall time [ns]."""
        return self._position if self._paused else self._position + round((now - self._since) * self.rate)

    def due(self, log_time: int) -> int:
        """Return the wall time [ns] of a log time if there is no further pause."""
        return self._since + round((log_time - self._position) / self.rate)

    def pause(self, now: int) -> None:
        """Stop at the current position."""
        self._position = self.position(now)
        self._since = now
        self._paused = True

    def resume(self, now: int) -> None:
        """Continue from the current position."""
        self._since = now
        self._paused = False

    def jump(self, position: int, now: int) -> None:
        """Move to a log time; a paused playback stays paused."""
        self._position = position
        self._since = now


class _Jump(Exception):
    """The user has moved to another position."""


class Player:
    """One playback."""

    def __init__(
        self, recording: Recording, wants: Callable[[str], bool], rename: Callable[[str], str], *, rate: float = 1.0,
        offset: float = 0.0, loop: bool = False, paused: bool = False, stamp_now: bool = False,
        into_live: Collection[str] = (),
    ) -> None:
        """Prepare to play.

        Args:
            recording: open.
            wants: returns whether a topic is played.
            rename: returns the topic to publish under.
            rate: seconds of recording per second.
            offset: start position [s].
            loop: whether to start again at the end.
            paused: whether to wait for a key at the start.
            stamp_now: whether to shift all stamps to the present, so that ages are as recorded.
            into_live: keys of commands that are published into a live cell, too.
        """
        self.published = 0
        self.left_out: Counter[str] = Counter()  # commands by key
        self.is_live: Callable[[], bool] = lambda: True  # whether commands could reach a running cell
        self._into_live = into_live
        self.quit = False
        self._recording = recording
        self._wants = wants
        self.renamed = rename
        self._loop = loop
        self._start = recording.start + round(offset * 1e9)
        self._stamp_now = stamp_now
        self._writers: dict[str, RawWriter] = {}
        self.head = Playhead(self._start, time.time_ns(), rate=rate, paused=paused)
        self._steps = 0
        self._to_image = False
        self._jumped = False
        self._changed = asyncio.Event()
        run = recording.run
        self._speed, self._epoch = run.speed, run.epoch

    @property
    def position(self) -> float:
        """Position in the recording [s]."""
        now = self.head.position(time.time_ns())
        return max(0.0, min(now, self._recording.end) - self._recording.start) * 1e-9

    @property
    def has_subscribers(self) -> bool:
        """Whether any played topic has a subscriber."""
        return any(writer.matched for writer in self._writers.values())

    def declare(self, bus: Bus, topics: dict[str, tuple[str, str]]) -> None:
        """Declare a writer for each topic (with message class and kind), so that subscribers are known in time.

        Its writer ids and sequence numbers are new, so that readers of the original messages accept the played ones.
        """
        for topic, (message, kind) in topics.items():
            key = f"{bus.cell}/{self.renamed(topic)}"
            known = kind if kind in ("event", "state") else "stream"
            self._writers[topic] = bus.raw_writer(key, encoding_of(message), known)  # type: ignore[arg-type]

    def on_key(self, name: str) -> None:
        """Handle a key."""
        now = time.time_ns()
        if name == "space":
            (self.head.resume if self.head.paused else self.head.pause)(now)
        elif name in ("right", "down") and self.head.paused:
            self._steps, self._to_image = 1, name == "down"
        elif name == "left":
            self.head.jump(max(self._recording.start, self.head.position(now) - round(BACK * 1e9)), now)
            self._jumped = True
        elif name == "q":
            self.quit = True
        self._changed.set()

    async def run(self) -> None:
        """Play to the end, or until a key quits."""
        since = self._start
        self.head.jump(since, time.time_ns())
        while not self.quit:
            try:
                await self._play_from(since)
            except _Jump:
                since = self.head.position(time.time_ns())
                continue
            if self.quit or not self._loop:
                return
            since = self._start
            self.head.jump(since, time.time_ns())

    async def _play_from(self, since: int) -> None:
        for state in self._recording.states_before(since, self._wants):
            self._publish(state)
        for sample in self._recording.samples(self._wants, since):
            await self._until_due(sample)
            if self.quit:
                return
            self._publish(sample)

    async def _until_due(self, sample: Sample) -> None:
        await asyncio.sleep(0)  # so that keys are handled even if all messages are late
        while not self.quit:
            if self._jumped:
                self._jumped = False
                raise _Jump
            now = time.time_ns()
            wait = None if self.head.paused else (self.head.due(sample.log_time) - now) * 1e-9
            if wait is not None and wait <= 0:
                return
            if self.head.paused and self._steps:
                if not self._to_image or sample.message == IMAGE:
                    self._steps = 0
                self.head.jump(sample.log_time, now)
                return
            self._changed.clear()
            try:
                async with asyncio.timeout(wait):
                    await self._changed.wait()
            except TimeoutError:
                pass

    def _publish(self, sample: Sample) -> None:
        key = self.renamed(sample.topic)
        if is_command(key, sample.message) and key not in self._into_live and self.is_live():
            self.left_out[key] += 1
            return
        payload = restamp(sample.payload, self._present) if self._stamp_now else sample.payload
        if writer := self._writers.get(sample.topic):  # a damaged index may omit a topic
            writer.put(payload, sample.trace)
            self.published += 1

    def _present(self, stamp: int) -> int:
        """Return a recorded stamp [ns] shifted to the present: from cell time to wall time, then to now."""
        recorded = self._epoch + round((stamp - self._epoch) / self._speed) if self._epoch else stamp
        return self.head.due(recorded)


# --- the `play` command -----------------------------------------------------------------------------------------------


class Echo(Protocol):
    """Called with lines for the user; warnings go to stderr."""

    def __call__(self, text: str, *, err: bool = False) -> None:
        """Show a line."""


def renaming(pairs: list[str]) -> Callable[[str], str]:
    """Return the function of `--remap FROM:=TO` options, which maps a topic to the one to publish under.

    Raises:
        ConfigError: a pair is invalid.
    """
    table: dict[str, str] = {}
    for pair in pairs:
        if not (match := re.fullmatch(r"([^:=#?*$]+):=([^:=#?*$]+)", pair)) or any(
            part.startswith("/") or part.endswith("/") or "//" in part for part in match.groups()
        ):
            raise ConfigError("--remap", pair, "must be FROM:=TO, such as camera/image_raw:=test/image")
        table[match[1]] = match[2]
    return lambda topic: table.get(topic, topic)


@cache
def is_command(key: str, message: str) -> bool:
    """Return whether messages of a key make something move or switch; a cell may have remapped it to any other key."""
    commands = [topic for topic in all_topics().values() if isinstance(topic, Topic) and topic.commands]
    return any(key == topic.key or message == topic.message.__name__ for topic in commands)


def played_topics(recording: Recording, selection: Selection) -> dict[str, tuple[str, str]]:
    """Return the selected topics, with message class and kind.

    Raises:
        ConfigError: a selected topic is not in the recording, or none is.
        RecordingError: a topic is not a valid key.
    """
    every = recording.topics()
    selection.require_in(every, recording.path, "KEY")
    selected = {topic: what for topic, what in every.items() if selection.wants(topic)}
    for topic in selected:
        if not is_key(topic):
            raise RecordingError(f"{recording.path}: has messages of {topic[:60]!r}, which is not a key")
    if not selected:
        raise ConfigError(str(recording.path), ..., "has no message of the selected topics")
    return selected


async def play(
    create: Callable[[], Player], recording: Recording, topics: dict[str, tuple[str, str]], cell: str, wait: list[str],
    domain: str | None, connect: str | None, echo: Echo, show: Callable[[str], None] | None,
) -> int:
    """Play a recording to its end, or until a signal or key; return the exit code.

    Args:
        create: creates the player; called on the running loop.
        recording: to play.
        topics: message class and kind of the topics to play.
        cell: name to play as.
        wait: services that must be ready before.
        domain: of `--domain`; a router is started if there is none.
        connect: of `--connect`; no router is started.
        echo: called with lines for the user.
        show: called with a line that replaces the one before; None without a terminal.
    """
    interrupts = Interrupts()
    interrupts.install()
    endpoint = endpoint_of(domain, connect)
    async with (
        _router(endpoint, may_start=connect is None) as own_router,
        connect_to(cell=cell, service=TOOL, endpoint=endpoint, clock=Clock.from_environment()) as bus,
    ):
        player, executor = create(), bus.client(MOTION_EXECUTE)
        player.is_live = lambda: not own_router or executor.available
        player.declare(bus, topics)
        bus.announce()
        with Keys(player.on_key, on_terminal=show is not None):
            tasks = [asyncio.create_task(_wait_and_run(player, bus, wait)), asyncio.create_task(interrupts.stop.wait())]
            ending = set(tasks)
            if show:
                tasks.append(asyncio.create_task(_show(player, recording, show)))
            where = f"{endpoint}{', a router of its own' if own_router else ''}"
            echo(f"playing {recording.path} ({recording.seconds:.1f} s) as {cell} at {where}")
            if show:
                echo(HELP)
            if recording.flaw:
                echo(f"the recording is {recording.flaw}; to repair it: zencell recover {recording.path}", err=True)
            for name, topic in await writers_of(bus, map(player.renamed, topics)):
                echo(f"{name} is up and publishes {topic} too: subscribers receive both", err=True)
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
        echo(f"played {player.published:,} messages")
        for key, count in player.left_out.items():
            echo(f"left out {count:,} of {key}: they would command {cell}, which is up. Play in a domain of its own "
                 f"(--domain), or see --into-live", err=True)
        if own_router and player.has_subscribers:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LINGER):
                    await interrupts.stop.wait()
    return 128 + interrupts.signal if interrupts.signal else 0


@contextlib.asynccontextmanager
async def _router(endpoint: str, *, may_start: bool) -> AsyncIterator[bool]:
    """Ensure a router at the endpoint during the block; yield whether it was started here."""
    if not may_start or await asyncio.to_thread(is_listening, endpoint):
        yield False
        return
    session = await asyncio.to_thread(open_router, [endpoint])
    try:
        yield True
    finally:
        await close_within(session, CLOSE)


async def _wait_and_run(player: Player, bus: Bus, wait: list[str]) -> None:
    for name in wait:
        await bus.alive.wait(name)
    await player.run()


async def _show(player: Player, recording: Recording, show: Callable[[str], None]) -> None:
    while True:
        state = "paused" if player.head.paused else f"x{player.head.rate:g}"
        show(f"{player.position:7.1f} / {recording.seconds:.1f} s  {state}  {player.published:,} messages")
        await asyncio.sleep(SHOW_PERIOD)
