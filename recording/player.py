"""Publishes what was recorded, when it is due, and does what the person at the keys says meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections.abc import AsyncIterator, Callable
from typing import TYPE_CHECKING, Protocol

from common.client.joining import is_listening
from common.client.keys import writers_of
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
from recording.reader import Recording
from recording.sample import RecordingError, encoding_of, restamp
from recording.selection import Playhead, Selection

if TYPE_CHECKING:
    from common.transport.writer import RawWriter
    from recording.sample import Sample


BACK = 5.0  # [s] that a key jumps back
PICTURE = "Image"


class _Jump(Exception):
    """The person wants to be elsewhere in the recording."""


class Player:
    """One playback."""

    def __init__(
        self, recording: Recording, wants: Callable[[str], bool], rename: Callable[[str], str], *, rate: float = 1.0,
        offset: float = 0.0, loop: bool = False, paused: bool = False, stamp_now: bool = False,
    ) -> None:
        """Prepare to play.

        Args:
            recording: open.
            wants: whether a topic is played.
            rename: the topic under which a topic is published.
            rate: seconds of recording per second.
            offset: where to begin [s].
            loop: begin again at the end.
            paused: wait for a key at the start.
            stamp_now: move all stamps to the present, so that ages are what they were when it was recorded.
        """
        self.published = 0
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
        self._to_picture = False
        self._jumped = False
        self._changed = asyncio.Event()
        run = recording.run
        self._speed, self._epoch = run.speed, run.epoch

    @property
    def position(self) -> float:
        """Where in the recording it is [s]."""
        now = self.head.position(time.time_ns())
        return max(0.0, min(now, self._recording.end) - self._recording.start) * 1e-9

    @property
    def heard(self) -> bool:
        """Whether anybody listens to what is played."""
        return any(writer.matched for writer in self._writers.values())

    def declare(self, bus: Bus, topics: dict[str, tuple[str, str]]) -> None:
        """Declare a writer for each topic, given with message class and kind: who listens is known before it speaks.

        Its ids and numbers are its own, so that readers which have heard the topic before take what it says for new.
        """
        for topic, (message, kind) in topics.items():
            key = f"{bus.cell}/{self.renamed(topic)}"
            known = kind if kind in ("event", "state") else "stream"
            self._writers[topic] = bus.raw_writer(key, encoding_of(message), known)  # type: ignore[arg-type]

    def on_key(self, name: str) -> None:
        """Do what a key says."""
        now = time.time_ns()
        if name == "space":
            (self.head.resume if self.head.paused else self.head.pause)(now)
        elif name in ("right", "down") and self.head.paused:
            self._steps, self._to_picture = 1, name == "down"
        elif name == "left":
            self.head.jump(max(self._recording.start, self.head.position(now) - round(BACK * 1e9)), now)
            self._jumped = True
        elif name == "q":
            self.quit = True
        self._changed.set()

    async def run(self) -> None:
        """Play to the end, or until a key says otherwise."""
        since = self._start
        self.head.jump(since, time.time_ns())
        while not self.quit:
            try:
                await self._through(since)
            except _Jump:
                since = self.head.position(time.time_ns())
                continue
            if self.quit or not self._loop:
                return
            since = self._start
            self.head.jump(since, time.time_ns())

    async def _through(self, since: int) -> None:
        for state in self._recording.states_before(since, self._wants):
            self._publish(state)
        for sample in self._recording.samples(self._wants, since):
            await self._until_due(sample)
            if self.quit:
                return
            self._publish(sample)

    async def _until_due(self, sample: Sample) -> None:
        await asyncio.sleep(0)  # keys are heard also when all is late
        while not self.quit:
            if self._jumped:
                self._jumped = False
                raise _Jump
            now = time.time_ns()
            wait = None if self.head.paused else (self.head.due(sample.log_time) - now) * 1e-9
            if wait is not None and wait <= 0:
                return
            if self.head.paused and self._steps:
                if not self._to_picture or sample.message == PICTURE:
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
        payload = restamp(sample.payload, self._present) if self._stamp_now else sample.payload
        if writer := self._writers.get(sample.topic):  # the index of a file may leave one out
            writer.put(payload, sample.trace)
            self.published += 1

    def _present(self, stamp: int) -> int:
        """The stamp [ns] that belongs to a recorded one: from cell time to wall time, and from then to now."""
        then = self._epoch + round((stamp - self._epoch) / self._speed) if self._epoch else stamp
        return self.head.due(then)


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
