"""Which services of a cell are alive, from their liveliness tokens."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

from common.transport.handoff import call_on_loop
from common.transport.session import Session


def alive_key(cell: str, service: str = "*") -> str:
    """Key of the token with which a service says that it is ready."""
    return f"{cell}/alive/{service}"


class Alive:
    """The names of the services that are ready now."""

    def __init__(self, session: Session, cell: str, loop: asyncio.AbstractEventLoop) -> None:
        self._names: set[str] = set()
        self._callbacks: list[Callable[[str, bool], None]] = []
        self._queues: set[asyncio.Queue[tuple[str, bool]]] = set()
        self._waiters: set[asyncio.Event] = set()
        session.watch_tokens(
            alive_key(cell), lambda token, there: call_on_loop(loop, lambda: self._on_token(token, there))
        )

    def _on_token(self, token: str, there: bool) -> None:
        name = token.rpartition("/")[2]
        if (name in self._names) == there:
            return
        (self._names.add if there else self._names.discard)(name)
        for callback in self._callbacks:
            callback(name, there)
        for queue in self._queues:
            queue.put_nowait((name, there))
        for event in self._waiters:
            event.set()

    @property
    def names(self) -> frozenset[str]:
        """Names of the services that are ready."""
        return frozenset(self._names)

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def on_change(self, callback: Callable[[str, bool], None]) -> None:
        """Have `callback(name, there)` called on the loop for each service that appears or vanishes."""
        self._callbacks.append(callback)

    async def changes(self) -> AsyncIterator[tuple[str, bool]]:
        """Each service that appears or vanishes from now on, as (name, there)."""
        queue: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        self._queues.add(queue)
        try:
            while True:
                yield await queue.get()
        finally:
            self._queues.discard(queue)

    async def wait(self, name: str, timeout: float | None = None, *, there: bool = True) -> None:
        """Return as soon as the service is ready (or gone, with `there=False`).

        Raises:
            TimeoutError: it was not within `timeout` seconds.
        """
        event = asyncio.Event()
        self._waiters.add(event)
        try:
            async with asyncio.timeout(timeout):
                while (name in self._names) != there:
                    event.clear()
                    await event.wait()
        finally:
            self._waiters.discard(event)
