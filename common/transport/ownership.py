"""Who writes and serves which key: a token for each of them, by which a second one finds the first and gives way.

Whoever asks for a key that is alive is refused at its start. Two that are both up, because the network was split when
they started, see each other when it is whole again: the one that was ready first goes on, the other ends.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from common.errors import ConfigError
from common.sources import new_id, wall_ns
from common.topics import MOTION_JOG, general_key
from common.transport.handoff import Doorbell
from common.transport.keys import owns_key
from common.transport.session import Declared, Session
from common.transport.tokens import tokens_now

# What the supervisors of linked hosts say under one key, and whoever jogs; the readers tell them apart.
SHARED = ("log/supervisor", "counters/supervisor", "supervisor/status", MOTION_JOG.key)
GIVE_UP = 3.0  # [s] longer than a link that was cut stands: the one before may be gone and its tokens not yet
LOOK_PERIOD = 0.2  # [s]
LOOK = 3.0  # [s] for an answer: longer than a link holds anything up before it is cut, so that no answer means nobody
MEET = 0.5  # [s] that somebody else must own what is ours before one of the two ends: tokens of who is gone go at once
MOST_OTHERS = 16  # that are known to own a key of ours too: those that were there first
MOST_TOLD = 8  # of whom a line of the log tells in TELL_SECONDS
TELL_SECONDS = 60.0
_ASKS = "f" * 16  # instead of a time: later than everybody who is ready


def process_name(life: str, since: int | None = None) -> str:
    """What a process is called in its tokens.

    Args:
        life: id of the process.
        since: when it became ready [ns since the Unix epoch]; None: it is not yet.
    """
    return f"{_ASKS if since is None else format(max(since, 0), '016x')}-{life}"


@dataclass(frozen=True)
class Owner:
    """Somebody who writes or serves a key: under which word of its own, as which service, and in which process."""

    key: str
    own: str
    service: str
    process: str

    @property
    def token(self) -> str:
        """Its token, without the cell."""
        return owns_key("", self.key, self.own, self.service, self.process)

    @property
    def life(self) -> str:
        """Id of the process, whether it is ready or asks."""
        return self.process.rpartition("-")[2]

    @property
    def asks(self) -> bool:
        """Whether it is not ready yet, and gives way to who is."""
        return self.process.startswith(_ASKS)

    def was_before(self, other: Owner) -> bool:
        """Whether this one stays and the other ends, where both are ready."""
        return self.process < other.process

    @classmethod
    def of(cls, token: str) -> Owner:
        """Who holds a token."""
        _, _, key, own, service, process, *_ = *token.split("/"), "", "", "", ""  # of a pattern, which may be shorter
        return cls(key.replace("|", "/"), own.replace("|", "/"), service, process)


def who_owns(owners: Iterable[Owner]) -> list[Owner]:
    """Each owner once, by service and key; who just became ready has both its tokens for a moment."""
    found: dict[tuple[str, str, str], Owner] = {}
    for owner in owners:
        one = (owner.service, owner.key, owner.life)
        if one not in found or not owner.asks:
            found[one] = owner
    return [found[one] for one in sorted(found)]


class Ownership:
    """What a service writes and serves in its cell, with a token for each key, and who else has one of them."""

    def __init__(
        self, session: Session, cell: str, service: str, *, loop: asyncio.AbstractEventLoop,
        warn: Callable[[str], None], lose: Callable[[ConfigError], None],
    ) -> None:
        """Own nothing yet.

        Args:
            session: connection to the network.
            cell: name of the cell.
            service: name of the service.
            loop: on which all of this runs.
            warn: called with a line for the log.
            lose: called when a key of ours is that of somebody else, who was there first: this one has to end.
        """
        self._session, self._cell, self._service = session, cell, service
        self._loop, self._warn, self._lose = loop, warn, lose
        self._life = new_id()
        self._mine: dict[str, Owner] = {}  # by key
        self._tokens: list[Declared] = []
        self._settled = False
        self._lock = threading.Lock()
        # Of each key of ours, as far as they have shown up since; when, or None once that was judged.
        self._others: dict[str, dict[Owner, float | None]] = {}
        # They gave way before they were judged: by their clock they had met us for long enough, by ours not quite.
        self._gone: deque[Owner] = deque(maxlen=MOST_OTHERS)
        self._bell = Doorbell(loop, self._look)
        self._next_look: asyncio.TimerHandle | None = None
        self._told: deque[tuple[float, str]] = deque(maxlen=64)  # when, of whom by process
        self._untold = 0

    def claim(self, key: str, own: str) -> None:
        """Take note that a key is written or served here, under a word of our own; it is ours from `settle` on."""
        if key in SHARED or key in self._mine:
            return
        since = wall_ns() if self._settled else None
        self._mine[key] = Owner(key, own, self._service, process_name(self._life, since))
        if since is not None:
            self._declare(self._mine[key])
            self._watch(key)

    async def settle(self) -> None:
        """Return when all that was claimed is ours; from then on look out for others who own it too.

        Raises:
            ConfigError: it is somebody else's, and stays so; names both and what helps.
        """
        for owner in self._mine.values():  # asked for aloud, so that one of two that ask gives way
            self._declare(owner)
        await self._require_only()
        asked, self._tokens = self._tokens, []
        process = process_name(self._life, wall_ns())
        for key, owner in self._mine.items():
            self._mine[key] = replace(owner, process=process)
            self._declare(self._mine[key])
        for token in asked:
            token.undeclare()
        self._settled = True
        for key in self._mine:
            self._watch(key)

    async def owners(self, *keys: str) -> list[Owner]:
        """Who writes or serves these keys in the cell now, or any: services that are ready or just become so."""
        asked = [owns_key(self._cell, key) for key in keys or "*"]
        found = await asyncio.gather(*(tokens_now(self._session, key, self._loop, LOOK) for key in asked))
        others = [Owner.of(token) for tokens in found for token in tokens]
        # What is ours is known. Zenoh leaves out of its answer, on a busy machine one time in a thousand, what a watch
        # that has just begun is being told of.
        ours = [owner for key, owner in self._mine.items() if self._settled and (not keys or key in keys)]
        return who_owns([*others, *ours])

    def close(self) -> None:
        """Own nothing any more."""
        for token in reversed(self._tokens):
            token.undeclare()
        self._mine.clear()
        with self._lock:
            self._others.clear()

    def _declare(self, owner: Owner) -> None:
        self._tokens.append(self._session.token(f"{self._cell}{owner.token}"))

    async def _require_only(self) -> None:
        deadline = self._loop.time() + GIVE_UP
        while self._mine:
            found = await self.owners(*self._mine)  # not of all keys: of some there may be any number
            others = [each for each in found if each.key in self._mine and each.life != self._life]
            if not others:
                return
            if self._loop.time() > deadline:
                other = min(others, key=lambda each: (general_key(each.key) != each.key, each.service, each.key))
                raise ConfigError(f"services.{self._service}", ..., refusal(self._mine[other.key], other))
            await asyncio.sleep(LOOK_PERIOD)

    def _watch(self, key: str) -> None:
        """Look out for others who own a key of ours; what goes on under other keys never comes here."""
        self._session.watch_tokens(owns_key(self._cell, key), self._hear, lambda _: None, lambda: None)

    def _hear(self, token: str, there: bool) -> None:
        """Take note of a token, on any thread; of another owner of what is ours it is looked at again in a moment."""
        other = Owner.of(token)
        if other.key not in self._mine or other.life == self._life:
            return
        with self._lock:
            others = self._others.setdefault(other.key, {})
            if not there:
                if others.pop(other, None) is not None and not other.asks:
                    self._gone.append(other)
            elif other not in others:
                others[other] = self._loop.time()
                if len(others) > MOST_OTHERS:  # who was there first matters most
                    del others[max(others, key=lambda each: each.process)]
        self._bell.ring()

    def _look(self) -> None:
        """Judge whoever has owned a key of ours for long enough; look again when the next one has."""
        now = self._loop.time()
        later: list[float] = []
        with self._lock:
            due = [other for other in self._gone if (mine := self._mine.get(other.key)) and mine.was_before(other)]
            self._gone.clear()
            for others in self._others.values():
                for other, since in others.items():
                    if since is not None and since + MEET <= now:
                        due.append(other)
                        others[other] = None
                    elif since is not None:
                        later.append(since + MEET)
        if self._next_look is not None:
            self._next_look.cancel()
        self._next_look = self._loop.call_at(min(later), self._look) if later else None
        for other in due:
            if other.key in self._mine:  # not closed
                self._judge(other, now)

    def _judge(self, other: Owner, now: float) -> None:
        """Say who of the two stays, if that is news; lose if it is the other."""
        mine = self._mine[other.key]
        who = f"another {other.service}" if other.service == self._service else other.service
        who = f"{who} (process {other.life})"
        if not mine.was_before(other):
            told = f"{who} has {mine.key} and was there first: this one ends"
            self._lose(ConfigError(f"services.{self._service}", ..., told))
        elif not any(life == other.life for _, life in self._told):
            if sum(then > now - TELL_SECONDS for then, _ in self._told) >= MOST_TOLD:
                self._untold += 1
                return
            untold, self._untold = self._untold, 0
            also = f"; so did {untold} before" if untold else ""
            self._warn(f"{who} claims {mine.key} too and gives way: this one was there first{also}")
        self._told.append((now, other.life))


def refusal(mine: Owner, other: Owner) -> str:
    """Why a key cannot be ours too, and what helps."""
    if mine.service == other.service:
        return f"another {mine.service} is up, which has {mine.key} already: end it first, or start one"
    folder, slash, last = mine.own.rpartition("/")
    example = f"{folder}/*: {mine.service}/*" if slash else f"{last}: {mine.service}/{last}"
    return (f"{other.service} has {mine.key} already, and a key is written or served by one service: give "
            f"{mine.service} or {other.service} keys of its own, as in topics: {{{example}}}")
