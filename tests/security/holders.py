"""Somebody who holds a certificate, or claims to, with nothing of the project between him and the network."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import zenoh

from common.transport.credentials import Credentials
from common.transport.endpoint import client_config

PATIENCE = 30.0  # [s] only ever waited for by a test that fails
NOBODY = b"Timeout"  # what Zenoh itself says when there was no answer
REFUSED = 1500  # [ms] in which a connection that is refused is tried


def direct(callback: Callable[[Any], None]) -> Any:
    # The default, an indirect callback, makes a thread that keeps the interpreter from ending.
    return zenoh.handlers.Callback(callback, indirect=False)


class Holder:
    """A connection with somebody's certificate; a `with` block."""

    def __init__(self, endpoint: str, credentials: Credentials | None, *, connect_ms: int = int(PATIENCE * 1000)):
        self._session = zenoh.open(client_config(endpoint, connect_ms=connect_ms, credentials=credentials))
        self._kept: list[Any] = []  # what nobody holds is taken back

    def __enter__(self) -> Holder:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    @property
    def connected(self) -> bool:
        return bool(self._session.info.routers_zid())

    def put(self, key: str, payload: bytes = b"", attachment: bytes | None = None) -> None:
        self._session.put(key, payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)

    def delete(self, key: str) -> None:
        self._session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)

    def hear(self, *keys: str) -> Heard:
        heard = Heard()
        for key in keys:
            self._kept.append(self._session.declare_subscriber(key, direct(heard.add)))
        return heard

    def answer(self, key: str, payload: bytes) -> Heard:
        """Answer everybody who asks for a key; what was asked."""
        heard = Heard()

        def reply(query: zenoh.Query) -> None:
            with query:
                heard.add(query)
                query.reply(key, payload)

        self._kept.append(self._session.declare_queryable(key, direct(reply)))
        return heard

    def ask(self, key: str, payload: bytes | None = None, *, timeout: float = 2.0) -> list[bytes]:
        """The answers, errors too; all who answer the key are asked."""
        replies = self._session.get(key, payload=payload, timeout=timeout, target=zenoh.QueryTarget.ALL,
                                    consolidation=zenoh.ConsolidationMode.NONE)
        results = [reply.ok or reply.err for reply in replies]
        answers = [result.payload.to_bytes() for result in results if result is not None]
        return [answer for answer in answers if answer != NOBODY]

    def claim(self, token: str) -> None:
        self._kept.append(self._session.liveliness().declare_token(token))

    def tokens(self, key: str) -> list[str]:
        return [str(reply.ok.key_expr) for reply in self._session.liveliness().get(key, timeout=2.0) if reply.ok]

    def watch(self, key: str) -> Heard:
        heard = Heard()
        self._kept.append(self._session.liveliness().declare_subscriber(key, direct(heard.add), history=True))
        return heard


class Heard:
    """What has come, from any thread."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self.samples: list[tuple[str, bytes]] = []

    def add(self, sample: Any) -> None:
        payload = sample.payload.to_bytes() if sample.payload is not None else b""
        with self._changed:
            self.samples.append((str(sample.key_expr), payload))
            self._changed.notify_all()

    @property
    def keys(self) -> set[str]:
        with self._changed:
            return {key for key, _ in self.samples}

    def wait(self, condition: Callable[[list[tuple[str, bytes]]], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: condition(self.samples), PATIENCE), self.samples[-5:]

    def soon(self, seconds: float) -> None:
        """Return when something has come, or after so long."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self.samples), seconds)

    def wait_for(self, key: str, payload: bytes | None = None) -> None:
        self.wait(lambda samples: any(k == key and payload in (None, p) for k, p in samples))
