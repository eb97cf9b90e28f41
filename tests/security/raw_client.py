"""A plain Zenoh client with any certificate, or none: what an attacker has, without the project's own transport."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import zenoh

from common.transport.credentials import Credentials
from common.transport.endpoint import client_config
from security.certificates import Authority

TIMEOUT = 30.0  # [s] only a failing test waits that long
TIMEOUT_REPLY = b"Timeout"  # of Zenoh itself, when no queryable has replied
REFUSAL_MS = 1500  # [ms] for which a connection is tried that must be refused
Samples = list[tuple[str, bytes]]


def issue(
    authority: Authority, name: str, folder: Path, days: float = 10, *, file: str = "", hosts: Iterable[str] = ()
) -> Credentials:
    """Issue a certificate for a name; its files are named after it, or `file`."""
    made = Credentials(folder / "ca.pem", folder / f"{file or name}.pem", folder / f"{file or name}.key")
    authority.issue(name, list(hosts), days, made.certificate, made.key)
    return made


def direct(callback: Callable[[Any], None]) -> Any:
    # The default, an indirect callback, starts a thread that keeps the interpreter from exiting.
    return zenoh.handlers.Callback(callback, indirect=False)


class RawClient:
    """A session with the given certificate; a `with` block."""

    def __init__(self, endpoint: str, credentials: Credentials | None, *, connect_ms: int = int(TIMEOUT * 1000)):
        self._session = zenoh.open(client_config(endpoint, connect_ms=connect_ms, credentials=credentials))
        self._declarations: list[Any] = []  # Zenoh undeclares one that is no longer referenced

    def __enter__(self) -> RawClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    @property
    def connected(self) -> bool:
        return bool(self._session.info.routers_zid())

    def put(self, key: str, payload: bytes = b"") -> None:
        self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def delete(self, key: str) -> None:
        self._session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)

    def subscribe(self, *keys: str) -> Received:
        received = Received()
        self._declarations += [self._session.declare_subscriber(key, direct(received.add)) for key in keys]
        return received

    def serve(self, key: str, payload: bytes) -> Received:
        """Reply `payload` to every query for a key; return the queries."""
        received = Received()

        def reply(query: zenoh.Query) -> None:
            with query:
                received.add(query)
                query.reply(key, payload)

        self._declarations.append(self._session.declare_queryable(key, direct(reply)))
        return received

    def query(self, key: str, payload: bytes | None = None, *, timeout: float = TIMEOUT) -> list[bytes]:
        """Return the replies, error replies included, of all queryables of the key; at once when all have replied."""
        return self.query_all([key], payload, timeout=timeout)

    def query_all(self, keys: Iterable[str], payload: bytes | None = None, *, timeout: float = TIMEOUT) -> list[bytes]:
        """Return the replies to simultaneous queries."""
        queries = [self._session.get(key, payload=payload, timeout=timeout, target=zenoh.QueryTarget.ALL,
                                     consolidation=zenoh.ConsolidationMode.NONE) for key in keys]
        results = [reply.ok or reply.err for replies in queries for reply in replies]
        answers = [result.payload.to_bytes() for result in results if result is not None]
        return [answer for answer in answers if answer != TIMEOUT_REPLY]

    def declare_token(self, token: str) -> None:
        self._declarations.append(self._session.liveliness().declare_token(token))

    def tokens(self, key: str, *, timeout: float = TIMEOUT) -> list[str]:
        return [str(reply.ok.key_expr) for reply in self._session.liveliness().get(key, timeout=timeout) if reply.ok]

    def watch_tokens(self, key: str) -> Received:
        received = Received()
        subscriber = self._session.liveliness().declare_subscriber(key, direct(received.add), history=True)
        self._declarations.append(subscriber)
        return received


class Received:
    """Received samples or queries; filled by any thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.samples: Samples = []

    def add(self, sample: Any) -> None:
        payload = sample.payload.to_bytes() if sample.payload is not None else b""
        with self._changed:
            self.samples.append((str(sample.key_expr), payload))
            self._changed.notify_all()

    @property
    def keys(self) -> set[str]:
        with self._changed:
            return {key for key, _ in self.samples}

    def wait_until(self, condition: Callable[[Samples], bool], seconds: float) -> bool:
        """Return whether the samples satisfy a condition within `seconds`."""
        with self._changed:
            return self._changed.wait_for(lambda: condition(self.samples), seconds)

    def wait(self, condition: Callable[[Samples], bool]) -> None:
        assert self.wait_until(condition, TIMEOUT), self.samples[-5:]

    def wait_for(self, key: str, payload: bytes | None = None) -> None:
        self.wait(lambda samples: any(k == key and payload in (None, p) for k, p in samples))

    def repeat(self, publish: Callable[[], object]) -> None:
        """Publish again until a sample arrives: the subscription takes effect some time after its declaration."""
        for _ in range(200):
            publish()
            if self.wait_until(bool, 0.05):
                return
        raise AssertionError("no sample arrived")
