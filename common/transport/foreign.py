"""A session for keys outside of every cell: those of another middleware, in its own formats, on a router of Zenoh."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import zenoh
from zenoh import ext

from common.errors import NoRouter
from common.transport.endpoint import client_config
from common.transport.zenoh_session import ZenohSession

CONNECT_MS = 5000
RAW = "zenoh/bytes"  # encoding of payloads that say nothing about themselves: Zenoh's default


class ForeignPublisher:
    """Publishes under one key; a congested network drops the value. From one thread at a time."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    @property
    def matched(self) -> bool:
        """Whether there is a subscriber."""
        return bool(self._publisher.matching_status.matching)

    def watch(self, on_change: Callable[[bool], None]) -> None:
        """Call back, on the network's thread, when the first subscriber appears and when the last one is gone."""
        self._publisher.declare_matching_listener(
            zenoh.handlers.Callback(lambda status: on_change(status.matching), None, indirect=False))

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Publish one value."""
        self._publisher.put(payload, attachment=attachment)

    def undeclare(self) -> None:
        """Undeclare it."""
        self._publisher.undeclare()


class ForeignSession(ZenohSession):
    """A session that also publishes in the ways of others. Subscribers, queryables and tokens are those of its base."""

    @property
    def id(self) -> str:
        """Id of the session in Zenoh."""
        return str(self._session.info.zid())

    def foreign_publisher(
        self, key: str, *, reliable: bool, cached: int = 0, heartbeat: float = 0.5
    ) -> ForeignPublisher:
        """Declare a publisher.

        Args:
            key: complete.
            reliable: whether lost values are sent again.
            cached: newest values that late advanced subscribers get; 0: none.
            heartbeat: longest time until such a subscriber notices that it missed one [s].
        """
        how: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,
            "reliability": zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT}
        publisher: Any
        if cached:
            publisher = ext.declare_advanced_publisher(
                self._session, key, cache=ext.CacheConfig(max_samples=cached), publisher_detection=True,
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=heartbeat), **how)
        else:
            publisher = self._session.declare_publisher(key, **how)
        declared = ForeignPublisher(publisher)
        self._keep(declared)
        return declared


async def open_foreign(endpoint: str) -> ForeignSession:
    """Return an open session with a router.

    Raises:
        NoRouter: none answers within 5 s.
    """
    try:
        return ForeignSession(await asyncio.to_thread(zenoh.open, client_config(endpoint, connect_ms=CONNECT_MS)))
    except zenoh.ZError:
        raise NoRouter(endpoint) from None
