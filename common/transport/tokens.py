"""Liveliness tokens: which services are ready and who serves what, known before anything is asked."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import AsyncIterator, Callable
from functools import partial

from common.transport.handoff import Doorbell, call_on_loop
from common.transport.session import Session

log = logging.getLogger(__name__)

MOST_NAMES = 1000  # that are known of one key expression: far more than a cell has services
MOST_AT_ONCE = 64  # names whose changes are told in one turn of the loop
_OVERLAP_SECONDS = 1.0  # in which the watch has surely reported what the first question found


class TokenWatch:
    """The tokens under a key expression; what they name is the last part of them.

    However many come, each costs the network's thread the same, and a turn of the loop has few to tell of. A name that
    comes and goes faster than the loop turns is told of once: that it changed, and changed back.
    """

    def __init__(self, session: Session, key: str, loop: asyncio.AbstractEventLoop) -> None:
        self.left_out = 0  # tokens beyond those that are known
        self._key = key
        self._loop = loop
        self._lock = threading.Lock()  # around what comes from the network:
        self._watched: set[str] = set()
        self._first: set[str] = set()  # what the first question found and the watch has not reported yet
        self._changes: dict[str, list[bool]] = {}  # not told yet: whether a name is there, or is and is not, in order
        self._answered = False  # the first question
        # What the loop was told:
        self._names: dict[str, None] = {}
        self._frozen: frozenset[str] | None = None
        self._known = asyncio.Event()
        self._said_left_out = False
        self._callbacks: list[Callable[[str, bool], None]] = []
        self._waiters: dict[asyncio.Event, None] = {}  # in their order
        self._bell = Doorbell(loop, self._tell)
        session.watch_tokens(
            key,
            lambda token, there: self._hear(_name(token), there=there),
            lambda token: self._hear(_name(token), there=True, first=True),
            self._hear_known,
        )

    @property
    def names(self) -> frozenset[str]:
        """Names of the services whose token is there."""
        if self._frozen is None:
            self._frozen = frozenset(self._names)
        return self._frozen

    def on_change(self, callback: Callable[[str, bool], None]) -> None:
        """Have `callback(name, there)` called on the loop for each token that appears or vanishes."""
        self._callbacks.append(callback)

    async def known(self, timeout: float) -> None:
        """Return when the tokens that were there from the start are known, or after `timeout` seconds."""
        try:
            async with asyncio.timeout(timeout):  # wait_for of Python 3.11 can lose a cancellation
                await self._known.wait()
        except TimeoutError:
            return  # no router answers: nobody is there

    async def wait(self, condition: Callable[[frozenset[str]], bool], timeout: float | None) -> None:
        """Return as soon as the names fulfil a condition.

        Raises:
            TimeoutError: they did not within `timeout` seconds.
        """
        changed = asyncio.Event()
        self._waiters[changed] = None
        try:
            async with asyncio.timeout(timeout):
                while not condition(self.names):
                    changed.clear()
                    await changed.wait()
        finally:
            del self._waiters[changed]

    # --- on any thread --------------------------------------------------------------------------------------------

    def _hear(self, name: str, *, there: bool, first: bool = False) -> None:
        """Take note of a token that the watch tells of, or the first question."""
        with self._lock:
            was = name in self._watched or name in self._first
            if there and not was and len(self._watched) + len(self._first) >= MOST_NAMES:
                self.left_out += 1
            elif not first:
                self._first.discard(name)
                (self._watched.add if there else self._watched.discard)(name)
            elif not was:
                self._first.add(name)
            self._note(name, was=was)
        self._bell.ring()

    def _note(self, name: str, *, was: bool) -> None:
        """Have it told if a name has come or gone."""
        now = name in self._watched or name in self._first
        if now != was:
            changes = self._changes.setdefault(name, [])
            if len(changes) == 2:  # it was back where it had been
                changes.clear()
            changes.append(now)

    def _hear_known(self) -> None:
        with self._lock:
            self._answered = True
        self._bell.ring()

    # --- on the loop ----------------------------------------------------------------------------------------------

    def _tell(self) -> None:
        """Tell of some names; of more in the next turn."""
        try:
            for _ in range(MOST_AT_ONCE):
                with self._lock:
                    if not self._changes:
                        break
                    name = next(iter(self._changes))
                    changes = self._changes.pop(name)
                for there in changes:
                    self._change(name, there)
        finally:
            for changed in self._waiters:
                changed.set()
            self._go_on()

    def _change(self, name: str, there: bool) -> None:
        if there:
            self._names[name] = None
        else:
            self._names.pop(name, None)
        self._frozen = None
        for callback in self._callbacks:
            callback(name, there)

    def _go_on(self) -> None:
        with self._lock:
            more, answered = bool(self._changes), self._answered
        if more:
            self._bell.ring()
        elif answered and not self._known.is_set():
            self._known.set()
            self._loop.call_later(_OVERLAP_SECONDS, self._forget_first)
        if self.left_out and not self._said_left_out:
            self._said_left_out = True
            log.warning("%s: more than %d liveliness tokens; further ones are left out", self._key, MOST_NAMES)

    def _forget_first(self) -> None:
        with self._lock:
            gone, self._first = sorted(self._first), set()  # vanished between the question and the watch
            for name in gone:
                self._note(name, was=True)
        self._bell.ring()


async def tokens_now(session: Session, key: str, loop: asyncio.AbstractEventLoop, timeout: float) -> list[str]:
    """The tokens under a full key expression that are there now, as far as they are known after `timeout` seconds."""
    tokens: set[str] = set()
    done = asyncio.Event()
    session.get_tokens(key, tokens.add, partial(call_on_loop, loop, done.set), timeout=timeout)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout):
            await done.wait()
    return sorted(tokens)


def _name(token: str) -> str:
    return token.rpartition("/")[2]


_KNOWN_SECONDS = 1.0


class Alive:
    """The names of the services that are ready now."""

    def __init__(self, watch: TokenWatch) -> None:
        self._watch = watch

    @property
    def names(self) -> frozenset[str]:
        """Names of the services that are ready, as far as known: right after the first use see `known`."""
        return self._watch.names

    def __contains__(self, name: str) -> bool:
        return name in self._watch.names

    async def known(self, timeout: float = _KNOWN_SECONDS) -> frozenset[str]:
        """Names of the services that are ready, once those that were so from the start are known."""
        await self._watch.known(timeout)
        return self.names

    def on_change(self, callback: Callable[[str, bool], None]) -> None:
        """Have `callback(name, there)` called on the loop for each service that appears or vanishes."""
        self._watch.on_change(callback)

    async def changes(self) -> AsyncIterator[tuple[str, bool]]:
        """Each service that appears or vanishes from now on, as (name, there)."""
        queue: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        self._watch.on_change(lambda name, there: queue.put_nowait((name, there)))
        while True:
            yield await queue.get()

    async def wait(self, name: str, timeout: float | None = None, *, there: bool = True) -> None:
        """Return as soon as the service is ready (or gone, with `there=False`).

        Raises:
            TimeoutError: it was not within `timeout` seconds.
        """
        await self._watch.wait(lambda names: (name in names) == there, timeout)
