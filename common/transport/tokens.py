"""Liveliness tokens: which services are ready and which serve a key, known before a request is sent."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import AsyncIterator, Callable
from functools import partial

from common.transport.session import LoopNotifier, Session, call_on_loop

log = logging.getLogger(__name__)

MAX_NAMES = 1000  # known per key expression: far more than a cell has services
MAX_PER_TURN = 64  # names whose changes are reported in one turn of the loop
_OVERLAP_SECONDS = 1.0  # after which the watch has surely reported what the first query found
_KNOWN_SECONDS = 1.0


class TokenWatch:
    """The tokens under a key expression, by name: the last part of their key.

    Any flood of tokens costs the network thread a constant time each, and a turn of the loop little. A name that
    appears and vanishes faster than the loop turns is reported once for each direction.
    """

    def __init__(self, session: Session, key: str, loop: asyncio.AbstractEventLoop) -> None:
        self.left_out = 0  # tokens beyond MAX_NAMES
        self._key = key
        self._loop = loop
        self._lock = threading.Lock()  # guards what network threads write:
        self._watched: set[str] = set()
        self._first: set[str] = set()  # found by the first query, and not reported by the watch yet
        self._changes: dict[str, list[bool]] = {}  # by name, not reported yet: its last changes in order
        self._answered = False  # the first query
        # State of the loop:
        self._names: dict[str, None] = {}
        self._frozen: frozenset[str] | None = None
        self._known = asyncio.Event()
        self._left_out_logged = False
        self._callbacks: list[Callable[[str, bool], None]] = []
        self._waiters: dict[asyncio.Event, None] = {}  # in order
        self._notifier = LoopNotifier(loop, self._report)
        session.watch_tokens(
            key,
            lambda token, there: self._receive(_name(token), there=there),
            lambda token: self._receive(_name(token), there=True, first=True),
            self._receive_answered,
        )

    @property
    def names(self) -> frozenset[str]:
        """Names of the existing tokens."""
        if self._frozen is None:
            self._frozen = frozenset(self._names)
        return self._frozen

    def on_change(self, callback: Callable[[str, bool], None]) -> None:
        """Call `callback(name, there)` on the loop for each token that appears or vanishes."""
        self._callbacks.append(callback)

    async def known(self, timeout: float) -> None:
        """Return when the tokens that existed at the start are known, or after `timeout` seconds."""
        try:
            async with asyncio.timeout(timeout):  # wait_for of Python 3.11 can lose a cancellation
                await self._known.wait()
        except TimeoutError:
            return  # no router answers: there are none

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

    def _receive(self, name: str, *, there: bool, first: bool = False) -> None:
        """Take a token from the watch or from the first query."""
        with self._lock:
            was = name in self._watched or name in self._first
            if there and not was and len(self._watched) + len(self._first) >= MAX_NAMES:
                self.left_out += 1
            elif not first:
                self._first.discard(name)
                (self._watched.add if there else self._watched.discard)(name)
            elif not was:
                self._first.add(name)
            self._note_change(name, was=was)
        self._notifier.notify()

    def _note_change(self, name: str, *, was: bool) -> None:
        now = name in self._watched or name in self._first
        if now != was:
            changes = self._changes.setdefault(name, [])
            if len(changes) == 2:  # back at its state before both
                changes.clear()
            changes.append(now)

    def _receive_answered(self) -> None:
        with self._lock:
            self._answered = True
        self._notifier.notify()

    # --- on the loop ----------------------------------------------------------------------------------------------

    def _report(self) -> None:
        """Report some names, and the rest in the next turn of the loop."""
        try:
            for _ in range(MAX_PER_TURN):
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
            self._continue()

    def _change(self, name: str, there: bool) -> None:
        if there:
            self._names[name] = None
        else:
            self._names.pop(name, None)
        self._frozen = None
        for callback in self._callbacks:
            callback(name, there)

    def _continue(self) -> None:
        with self._lock:
            more, answered = bool(self._changes), self._answered
        if more:
            self._notifier.notify()
        elif answered and not self._known.is_set():
            self._known.set()
            self._loop.call_later(_OVERLAP_SECONDS, self._forget_first)
        if self.left_out and not self._left_out_logged:
            self._left_out_logged = True
            log.warning("%s: more than %d liveliness tokens; further ones are left out", self._key, MAX_NAMES)

    def _forget_first(self) -> None:
        with self._lock:
            gone, self._first = sorted(self._first), set()  # vanished between the query and the watch
            for name in gone:
                self._note_change(name, was=True)
        self._notifier.notify()


async def tokens_now(session: Session, key: str, loop: asyncio.AbstractEventLoop, timeout: float) -> list[str]:
    """Return the existing tokens under a full key expression, as far as known after `timeout` seconds."""
    tokens: set[str] = set()
    done = asyncio.Event()
    session.get_tokens(key, tokens.add, partial(call_on_loop, loop, done.set), timeout=timeout)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout):
            await done.wait()
    return sorted(tokens)


def _name(token: str) -> str:
    return token.rpartition("/")[2]


class Alive:
    """The names of the services that are ready."""

    def __init__(self, watch: TokenWatch) -> None:
        self._watch = watch

    @property
    def names(self) -> frozenset[str]:
        """Names of the ready services as far as known: right after the first use call `known`."""
        return self._watch.names

    def __contains__(self, name: str) -> bool:
        return name in self._watch.names

    async def known(self, timeout: float = _KNOWN_SECONDS) -> frozenset[str]:
        """Return the names of the ready services, once those that were ready at the start are known."""
        await self._watch.known(timeout)
        return self.names

    def on_change(self, callback: Callable[[str, bool], None]) -> None:
        """Call `callback(name, there)` on the loop for each service that appears or vanishes."""
        self._watch.on_change(callback)

    async def changes(self) -> AsyncIterator[tuple[str, bool]]:
        """Yield each service that appears or vanishes from now on, as (name, there)."""
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
