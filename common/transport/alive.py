"""Which services of a cell are ready, from their liveliness tokens."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

from common.transport.tokens import TokenWatch

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
