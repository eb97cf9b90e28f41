"""Liveliness tokens: which services are ready and who serves what, known before anything is asked."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable

from common.transport.handoff import call_on_loop
from common.transport.session import Session

_OVERLAP_SECONDS = 1.0  # in which the watch has surely reported what the first question found


class TokenWatch:
    """The tokens under a key expression; what they name is the last part of them, or told by `name`."""

    def __init__(
        self, session: Session, key: str, loop: asyncio.AbstractEventLoop, name: Callable[[str], str] | None = None
    ) -> None:
        self._loop = loop
        name = name or _name
        self._watched: set[str] = set()
        self._first: set[str] = set()  # what the first question found and the watch has not reported yet
        self._known = asyncio.Event()
        self._callbacks: list[Callable[[str, bool], None]] = []
        self._waiters: dict[asyncio.Event, None] = {}  # in their order
        session.watch_tokens(
            key,
            lambda token, there: call_on_loop(loop, lambda: self._on_token(name(token), there)),
            lambda token: call_on_loop(loop, lambda: self._on_first(name(token))),
            lambda: call_on_loop(loop, self._on_known),
        )

    @property
    def names(self) -> frozenset[str]:
        """Names of the services whose token is there."""
        return frozenset(self._watched | self._first)

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

    def _on_token(self, name: str, there: bool) -> None:
        before = self.names
        self._first.discard(name)
        (self._watched.add if there else self._watched.discard)(name)
        self._tell(before)

    def _on_first(self, name: str) -> None:
        if name not in self._watched:
            before = self.names
            self._first.add(name)
            self._tell(before)

    def _on_known(self) -> None:
        self._known.set()
        self._loop.call_later(_OVERLAP_SECONDS, self._forget_first)

    def _forget_first(self) -> None:
        before = self.names
        self._first.clear()  # vanished between the question and the watch
        self._tell(before)

    def _tell(self, before: frozenset[str]) -> None:
        now = self.names
        for name in sorted(before ^ now):
            for callback in self._callbacks:
                callback(name, name in now)
        if before != now:
            for changed in self._waiters:
                changed.set()


async def tokens_now(session: Session, key: str, loop: asyncio.AbstractEventLoop, timeout: float) -> list[str]:
    """The tokens under a full key expression that are there now, as far as they are known after `timeout` seconds."""
    tokens: list[str] = []
    done = asyncio.Event()
    session.get_tokens(key, tokens.append, lambda: call_on_loop(loop, done.set), timeout=timeout)
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
