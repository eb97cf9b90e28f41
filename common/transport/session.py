"""What the bus needs of a network, low enough that Zenoh and an in-process stand-in both give it.

Callbacks may come on any thread and must return at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol


class RawSample(NamedTuple):
    """A published value or a reply as it came, with its full key."""

    key: str
    payload: bytes
    encoding: str = ""
    attachment: bytes | None = None


class RawReply(NamedTuple):
    """A reply to a `get`: a sample, or the payload of an error."""

    sample: RawSample | None
    error: bytes = b""


class Query(Protocol):
    """A `get` that reached a queryable. `finish` must be called once, whatever happened."""

    key: str
    parameters: str
    payload: bytes | None
    attachment: bytes | None

    def reply(self, key: str, payload: bytes, encoding: str, attachment: bytes) -> None:
        """Send one answer under a key that the query covers."""

    def refuse(self, payload: bytes) -> None:
        """Send an error reply."""

    def finish(self) -> None:
        """No more replies come from here."""


class Declared(Protocol):
    """Something that was declared and can be taken back."""

    def undeclare(self) -> None:
        """Take it back; a second time does nothing."""


class Publisher(Declared, Protocol):
    """Where values of one key are put."""

    @property
    def matched(self) -> bool:
        """Whether anybody subscribes."""

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Hand one value over without ever blocking."""


OnSample = Callable[[RawSample], None]
OnQuery = Callable[[Query], None]
OnReply = Callable[[RawReply], None]
OnToken = Callable[[str, bool], None]  # full key of the token, whether it is there


class Session(Protocol):
    """A connection to the network of a cell."""

    @property
    def connected(self) -> bool:
        """Whether the router is reached (always, in process)."""

    def publisher(self, key: str, encoding: str, *, reliable: bool) -> Publisher:
        """Declare a publisher; one that is not reliable drops what the network cannot take."""

    def subscriber(self, key: str, on_sample: OnSample) -> Declared:
        """Call back for each value put under a matching key."""

    def queryable(self, key: str, on_query: OnQuery, *, complete: bool) -> Declared:
        """Call back for each `get` that covers the key; with `complete`, an exact `get` reaches just one of them."""

    def get(
        self,
        key: str,
        on_reply: OnReply,
        on_done: Callable[[], None],
        *,
        payload: bytes | None = None,
        encoding: str = "",
        attachment: bytes | None = None,
        timeout: float = 10.0,
    ) -> Callable[[], None]:
        """Ask everybody who serves the key; `on_done` comes once, after the last reply. Returns what cancels it."""

    def token(self, key: str) -> Declared:
        """Declare a liveliness token: it vanishes when this session does."""

    def watch_tokens(
        self, key: str, on_token: OnToken, on_first: Callable[[str], None], on_known: Callable[[], None]
    ) -> Declared:
        """Call back for each matching token that is there, appears or vanishes.

        A question comes before the watch, since a watch does not say when it has told all that was there: `on_first`
        for each token that it finds, then once `on_known`.
        """

    def get_tokens(
        self, key: str, on_token: Callable[[str], None], on_done: Callable[[], None], *, timeout: float
    ) -> None:
        """Call back for each matching token that is there now, then once `on_done`; before any watch that covers it."""

    def watch_connection(self, on_change: Callable[[], None]) -> None:
        """Call back when the router may have been lost or reached; `connected` tells a moment later."""

    def close(self) -> None:
        """Take back everything in reverse order and leave; may block, so call it in a thread with a time bound."""
