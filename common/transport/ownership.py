"""Which service writes or serves which key: one token for each, by which a second process detects the first.

A process that claims a key in use fails at its start. If two are ready because the network was split, they detect each
other once it heals: the process that was ready first keeps the key, the other one ends.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from common.errors import ConfigError
from common.time_source import new_id, wall_ns
from common.topics import MOTION_JOG, general_key
from common.transport.session import Declaration, LoopNotifier, Session, owns_key
from common.transport.tokens import tokens_now

# Keys with many writers: the supervisors of linked hosts, and every client that jogs. Readers distinguish them.
SHARED = ("log/supervisor", "counters/supervisor", "supervisor/status", MOTION_JOG.key)
CLAIM_SECONDS = 3.0  # longer than a dead link lives: tokens of the previous process may outlive it that long
CLAIM_PERIOD = 0.2  # [s] between two queries for other owners
QUERY_SECONDS = 3.0  # longer than any delay of a live link: no reply in this time means no owner
CONFLICT_SECONDS = 0.5  # that another owner must last before one of the two ends; tokens of ended ones vanish faster
MAX_OTHERS = 16  # other owners of one of our keys that are remembered: the first ones
MAX_WARNINGS = 8  # of other owners in WARNING_SECONDS
WARNING_SECONDS = 60.0
_CLAIMING = "f" * 16  # instead of a time: sorts after all processes that are ready


def process_name(instance: str, since: int | None = None) -> str:
    """Return the name of a process in its tokens.

    Args:
        instance: id of the process.
        since: when it became ready [ns since the Unix epoch]; None: not yet.
    """
    return f"{_CLAIMING if since is None else format(max(since, 0), '016x')}-{instance}"


@dataclass(frozen=True)
class Owner:
    """A process that writes or serves a key; `own` is that key before remapping."""

    key: str
    own: str
    service: str
    process: str

    @property
    def token(self) -> str:
        """Key of its token, without the cell."""
        return owns_key("", self.key, self.own, self.service, self.process)

    @property
    def instance(self) -> str:
        """Id of the process, ready or claiming."""
        return self.process.rpartition("-")[2]

    @property
    def claiming(self) -> bool:
        """Whether it is not ready yet, and gives way to a ready one."""
        return self.process.startswith(_CLAIMING)

    def precedes(self, other: Owner) -> bool:
        """Return whether this one keeps the key and the other ends, if both are ready."""
        return self.process < other.process

    @classmethod
    def of(cls, token: str) -> Owner:
        """Return the owner that holds a token."""
        _, _, key, own, service, process, *_ = *token.split("/"), "", "", "", ""  # a pattern may be shorter
        return cls(key.replace("|", "/"), own.replace("|", "/"), service, process)


def unique_owners(owners: Iterable[Owner]) -> list[Owner]:
    """Return each owner once, by service and key; a process that just became ready holds two tokens for a moment."""
    found: dict[tuple[str, str, str], Owner] = {}
    for owner in owners:
        one = (owner.service, owner.key, owner.instance)
        if one not in found or not owner.claiming:
            found[one] = owner
    return [found[one] for one in sorted(found)]


class Ownership:
    """The keys that a service writes and serves, with a token for each, and other owners of them."""

    def __init__(
        self, session: Session, cell: str, service: str, *, loop: asyncio.AbstractEventLoop,
        warn: Callable[[str], None], lose: Callable[[ConfigError], None],
    ) -> None:
        """Own nothing yet.

        Args:
            session: connection to the network.
            cell: name of the cell.
            service: name of the service.
            loop: on which all methods run.
            warn: called with a line for the log.
            lose: called when another process had one of our keys first: this process has to end.
        """
        self._session, self._cell, self._service = session, cell, service
        self._loop, self._warn, self._lose = loop, warn, lose
        self._instance = new_id()
        self._mine: dict[str, Owner] = {}  # by key
        self._tokens: list[Declaration] = []
        self._settled = False
        self._lock = threading.Lock()
        # By key, as they appeared since `settle`: when, or None once the conflict was resolved.
        self._others: dict[str, dict[Owner, float | None]] = {}
        # Gave way before we resolved the conflict: they had seen it for long enough by their clock, we not quite.
        self._gone: deque[Owner] = deque(maxlen=MAX_OTHERS)
        self._notifier = LoopNotifier(loop, self._check)
        self._next_check: asyncio.TimerHandle | None = None
        self._warned: deque[tuple[float, str]] = deque(maxlen=64)  # time and instance
        self._not_warned = 0

    def claim(self, key: str, own: str) -> None:
        """Add a key that is written or served here; `own` is the key before remapping. Held from `settle` on."""
        if key in SHARED or key in self._mine:
            return
        since = wall_ns() if self._settled else None
        self._mine[key] = Owner(key, own, self._service, process_name(self._instance, since))
        if since is not None:
            self._declare(self._mine[key])
            self._watch(key)

    async def settle(self) -> None:
        """Return when no other process has a claimed key; watch for other owners from then on.

        Raises:
            ConfigError: another service keeps one of them; names both and the remedy.
        """
        for owner in self._mine.values():  # claims are visible, so that one of two claiming processes gives way
            self._declare(owner)
        await self._require_only()
        claims, self._tokens = self._tokens, []
        process = process_name(self._instance, wall_ns())
        for key, owner in self._mine.items():
            self._mine[key] = replace(owner, process=process)
            self._declare(self._mine[key])
        for token in claims:
            token.undeclare()
        self._settled = True
        for key in self._mine:
            self._watch(key)

    async def owners(self, *keys: str) -> list[Owner]:
        """Return the owners of these keys, or of all: services that are ready or just becoming so."""
        patterns = [owns_key(self._cell, key) for key in keys or "*"]
        found = await asyncio.gather(*(tokens_now(self._session, key, self._loop, QUERY_SECONDS) for key in patterns))
        others = [Owner.of(token) for tokens in found for token in tokens]
        # Zenoh omits from a reply, one time in a thousand on a busy machine, tokens that it is just reporting to a new
        # watch. Our own keys are known anyway.
        ours = [owner for key, owner in self._mine.items() if self._settled and (not keys or key in keys)]
        return unique_owners([*others, *ours])

    def close(self) -> None:
        """Release all keys."""
        for token in reversed(self._tokens):
            token.undeclare()
        self._mine.clear()
        with self._lock:
            self._others.clear()

    def _declare(self, owner: Owner) -> None:
        self._tokens.append(self._session.token(f"{self._cell}{owner.token}"))

    async def _require_only(self) -> None:
        deadline = self._loop.time() + CLAIM_SECONDS
        while self._mine:
            found = await self.owners(*self._mine)  # not of all keys, of which there may be any number
            others = [each for each in found if each.key in self._mine and each.instance != self._instance]
            if not others:
                return
            if self._loop.time() > deadline:
                other = min(others, key=lambda each: (general_key(each.key) != each.key, each.service, each.key))
                raise ConfigError(f"services.{self._service}", ..., refusal(self._mine[other.key], other))
            await asyncio.sleep(CLAIM_PERIOD)

    def _watch(self, key: str) -> None:
        self._session.watch_tokens(owns_key(self._cell, key), self._receive, lambda _: None, lambda: None)

    def _receive(self, token: str, there: bool) -> None:
        """Take a token, on any thread; another owner of one of our keys is checked a moment later."""
        other = Owner.of(token)
        if other.key not in self._mine or other.instance == self._instance:
            return
        with self._lock:
            others = self._others.setdefault(other.key, {})
            if not there:
                if others.pop(other, None) is not None and not other.claiming:
                    self._gone.append(other)
            elif other not in others:
                others[other] = self._loop.time()
                if len(others) > MAX_OTHERS:  # the first ones matter most
                    del others[max(others, key=lambda each: each.process)]
        self._notifier.notify()

    def _check(self) -> None:
        """Resolve the conflicts that lasted long enough; schedule the check of the next one."""
        now = self._loop.time()
        later: list[float] = []
        with self._lock:
            due = [other for other in self._gone if (mine := self._mine.get(other.key)) and mine.precedes(other)]
            self._gone.clear()
            for others in self._others.values():
                for other, since in others.items():
                    if since is not None and since + CONFLICT_SECONDS <= now:
                        due.append(other)
                        others[other] = None
                    elif since is not None:
                        later.append(since + CONFLICT_SECONDS)
        if self._next_check is not None:
            self._next_check.cancel()
        self._next_check = self._loop.call_at(min(later), self._check) if later else None
        for other in due:
            if other.key in self._mine:  # not closed
                self._resolve(other, now)

    def _resolve(self, other: Owner, now: float) -> None:
        """Log the first conflict with another process that gives way; call `lose` if it came first."""
        mine = self._mine[other.key]
        name = f"another {other.service}" if other.service == self._service else other.service
        name = f"{name} (process {other.instance})"
        if not mine.precedes(other):
            reason = f"{name} has {mine.key} and was there first: this one ends"
            self._lose(ConfigError(f"services.{self._service}", ..., reason))
        elif not any(instance == other.instance for _, instance in self._warned):
            if sum(then > now - WARNING_SECONDS for then, _ in self._warned) >= MAX_WARNINGS:
                self._not_warned += 1
                return
            omitted, self._not_warned = self._not_warned, 0
            also = f"; so did {omitted} before" if omitted else ""
            self._warn(f"{name} claims {mine.key} too and gives way: this one was there first{also}")
        self._warned.append((now, other.instance))


def refusal(mine: Owner, other: Owner) -> str:
    """Return why a key cannot have this second owner, and the remedy."""
    if mine.service == other.service:
        return f"another {mine.service} is up, which has {mine.key} already: end it first, or start one"
    folder, slash, last = mine.own.rpartition("/")
    example = f"{folder}/*: {mine.service}/*" if slash else f"{last}: {mine.service}/{last}"
    return (f"{other.service} has {mine.key} already, and a key is written or served by one service: give "
            f"{mine.service} or {other.service} keys of its own, as in topics: {{{example}}}")
