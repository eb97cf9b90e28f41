"""A viser server that answers only who may open the page.

The guard is asked about each request before anything else reads it, and sends the page itself. Nothing is copied
through a second process and nothing else listens, so that no port is left unguarded.
"""

from __future__ import annotations

import asyncio
import gzip
import inspect
import itertools
import logging
import os
import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as websocket_server
from websockets import Data, Headers
from websockets.exceptions import WebSocketException
from websockets.http11 import Request, Response

from common.errors import ConfigError
from common.time_source import monotonic
from page.access import (
    SHORTEST_TOKEN,
    TOKEN,
    TOKEN_VARIABLE,
    Access,
    Answer,
    gateways,
    is_loopback,
    open_socket,
    refusal,
)
from page.doors import VISITOR, Doors, Visitor
from page.viser_inside import LINE, Beside, File, Process, client_files, let_in, made_server, quiet

log = logging.getLogger(__name__)

MAX_PAGES = 24  # open at once
MAX_LOOKING = 16  # of them, of those who may not operate: there is room for who may
WORDS = 100  # from each connection that are read at once, and in each second: a page that is dragged says fewer
MAX_CONNECTIONS = 96  # among them requests that are still read, and those who send none
MAX_MESSAGE = 4 * 2**20  # [bytes] from a browser
OPEN_TIMEOUT = 5.0  # [s] until a connection has sent its request
CLOSE_TIMEOUT = 0.5  # [s] for a browser to say goodbye
STOP_TIMEOUT = 1.5  # [s] for all of that; viser itself would wait for 6

# The page is one file: whatever it may become, it loads nothing from elsewhere, and stands in nobody else's frame.
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; media-src data: blob:; font-src 'self' data:; worker-src 'self' blob:; "
    "connect-src 'self' {own} data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def make_server(
    host: str, port: int, token: str = "", *, published: bool = False, secured: bool = False,
    tokens: Mapping[str, str] | None = None, doors: Doors | None = None, beside: Beside | None = None,
) -> viser.ViserServer:
    """A server of pages at host and port that refuses foreign web pages, foreign names, and who has not the token.

    Args:
        host: address or name to listen at; beyond this machine there must be a token.
        port: TCP port; 0 is any that is free (`server.get_port()`).
        token: that a browser has to bring once; empty: `ZENCELL_VIEWER_TOKEN`, and without that none is asked for.
        published: the port is reached through the loopback of a machine only, as that of a container: who comes from
            its gateway needs no token, and no other name than the loopback's is served.
        secured: there must be a token, wherever it listens.
        tokens: by role, beside that for everything.
        doors: are asked whether somebody may do what comes from a browser, where there is a token.
        beside: has the other connection of each page (line.py); without it that is closed at once.

    Raises:
        ConfigError: the port is taken (names by whom), the host is not of this machine, or the token is missing or
            too short.
    """
    token = token or os.environ.get(TOKEN_VARIABLE, "")
    _check_token("127.0.0.1" if published else host, token, secured, bool(tokens))
    try:
        listening = open_socket(host, port)
    except OSError as error:
        raise refusal(error, host, port) from None
    guard = Guard(Access(
        "127.0.0.1" if published else host, listening.getsockname()[1], token, tokens or {},
        gateways() if published else frozenset(),
    ), doors)
    server = made_server(listening, guard.before, OPTIONS, beside or _nobody)
    if doors is not None:
        doors.guarded = guard.access.asks
        let_in(server, partial(_admit, doors))
    if not (published or is_loopback(host)):
        log.warning(
            "the page is served beyond this machine, without encryption: `ssh -L %d:127.0.0.1:%d HOST` to a page on "
            "127.0.0.1 is the safe way", guard.access.port, guard.access.port,
        )
    return server


async def _nobody(connection: websocket_server.ServerConnection) -> None:
    """Say nothing: the connection ends."""


def _pages(connections: Iterable[websocket_server.ServerConnection], line: bool) -> int:
    """How many connections of that kind there are."""
    paths = [urlsplit(each.request.path).path for each in connections if each.request is not None]
    return sum((path == LINE) == line for path in paths)


def close_server(server: viser.ViserServer) -> None:
    """Close all pages and stop listening; what takes longer than `STOP_TIMEOUT` goes on in the background."""
    stopping = threading.Thread(target=server.stop, daemon=True)
    with quiet():
        stopping.start()
        stopping.join(STOP_TIMEOUT)
    if stopping.is_alive():
        log.warning("not all pages were closed within %g s", STOP_TIMEOUT)


def _admit(doors: Doors, part: str, value: object) -> bool:
    return doors.admit(VISITOR.get(), part, value)


class Guard:
    """Stands in front of what serves the page."""

    def __init__(self, access: Access, doors: Doors | None = None) -> None:
        """Hold to these rules, and tell the doors who has gone."""
        self.access = access
        self._numbers = itertools.count(1)
        self._looking: Counter[bool] = Counter()  # connections of those who may not operate: pages, and lines
        self._doors = doors
        self._waiting: set[asyncio.Task[None]] = set()

    async def _see_off(self, connection: websocket_server.ServerConnection, visitor: Visitor, line: bool) -> None:
        await connection.wait_closed()
        self._looking[line] -= "operate" not in visitor.roles
        if self._doors is not None:
            self._doors.leave(visitor)

    def before(self, process: Process) -> Process:
        """What to ask about a request instead of `process`, which is asked about those that may pass."""

        async def guarded(connection: websocket_server.ServerConnection, request: Request) -> Response | None:
            said = {name: request.headers.get_all(name) for name in ("host", "origin", "cookie")}
            upgrade = "upgrade" in request.headers
            line = urlsplit(request.path).path == LINE
            peer = str((connection.remote_address or ("",))[0])
            answer = self.access.answer(request.path, said, upgrade=upgrade, peer=peer)
            roles = self.access.roles(said["cookie"])
            looks = "operate" not in roles
            full = _pages(connection.server.connections, line) >= MAX_PAGES
            if answer is None and upgrade and (full or (looks and self._looking[line] >= MAX_LOOKING)):
                most = MAX_PAGES if full else MAX_LOOKING
                answer = Answer(HTTPStatus.SERVICE_UNAVAILABLE, f"{most} pages are open already: close one\n")
            if upgrade and answer is None:  # from here on this task and all that it starts handle their messages
                visitor = Visitor(0 if line else next(self._numbers), peer, roles)
                self._looking[line] += looks
                VISITOR.set(visitor)
                waiting = asyncio.create_task(self._see_off(connection, visitor, line))
                self._waiting.add(waiting)
                waiting.add_done_callback(self._waiting.discard)
            if answer is not None:
                if answer.status is not HTTPStatus.OK:
                    log.debug("refused %s: %s", connection.remote_address, answer.text)
                return _protected(_response(answer), said["host"])
            file = None if upgrade else client_files().get(urlsplit(request.path).path)
            if file is not None:
                return _protected(_sent(file, request), said["host"], lasts=file.lasts)
            response = process(connection, request)
            if inspect.isawaitable(response):
                response = await response
            return None if response is None else _protected(response, said["host"])

        return guarded


class Bounded(websocket_server.ServerConnection):
    """A connection that is dropped at once when there are too many, and read no faster than anybody speaks."""

    _left, _since = 0.0, 0.0

    async def recv(self, decode: bool | None = None) -> Data:  # type: ignore[override]
        """The next message, once it is its turn: who floods the page waits, not who presses STOP."""
        data = await super().recv(decode)
        now = monotonic()
        self._left, self._since = min(self._left + WORDS * (now - self._since), WORDS) - 1, now
        if self._left < 0:
            await asyncio.sleep(-self._left / WORDS)
        return data

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, and end when this is one too many."""
        super().connection_made(transport)
        if len(self.server.handlers) > MAX_CONNECTIONS:
            self.transport.abort()


def _check_token(host: str, token: str, secured: bool, others: bool) -> None:
    if secured and not (token or others):
        raise ConfigError("services.viewer.token", ..., f"is needed in a secured cell, as {TOKEN_VARIABLE} in the "
                          "environment; `zencell secure init DIR --renew` makes one for each role")
    if not (token or others or is_loopback(host)):
        raise ConfigError(
            "services.viewer.token", ..., f"is needed for a page at {host}, as {TOKEN_VARIABLE} in the environment"
        )
    if token and not TOKEN.fullmatch(token):
        raise ConfigError(
            "services.viewer.token", ..., f"must have {SHORTEST_TOKEN} or more of the characters A-Z a-z 0-9 - . _ ~"
        )


def _response(answer: Answer) -> Response:
    body = answer.text.encode()
    headers = Headers(answer.headers)
    headers["Content-Type"] = "text/html; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(answer.status.value, answer.status.phrase, headers, body)


def _sent(file: File, request: Request) -> Response:
    """A file of the page, compressed for those who understand it."""
    headers = Headers({"Content-Type": file.kind, "Vary": "Accept-Encoding", "Connection": "close"})
    body = file.body
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        headers["Content-Encoding"] = "gzip"
    else:
        body = gzip.decompress(body)
    headers["Content-Length"] = str(len(body))
    return Response(HTTPStatus.OK.value, HTTPStatus.OK.phrase, headers, body)


def _protected(response: Response, hosts: list[str], *, lasts: bool = False) -> Response:
    # Safari before 15.4 does not take 'self' for a WebSocket. The name was checked if this is the page itself.
    own = f"ws://{hosts[0]} wss://{hosts[0]}" if response.status_code == HTTPStatus.OK and len(hosts) == 1 else ""
    response.headers["Content-Security-Policy"] = POLICY.format(own=own)
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Referrer-Policy"] = "no-referrer"
    response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    response.headers["Cache-Control"] = "private, max-age=31536000, immutable" if lasts else "no-store"
    return response


def _is_news(record: logging.LogRecord) -> bool:
    if record.getMessage() == "opening handshake failed":
        return False  # who only knocks, or is dropped, is none
    if record.exc_info and isinstance(error := record.exc_info[1], WebSocketException):
        record.msg, record.args, record.exc_info = f"{record.getMessage()}: {error}", (), None  # theirs, not ours
    return True


_connection_log = logging.getLogger(f"{__name__}.connections")
_connection_log.setLevel(logging.WARNING)
_connection_log.addFilter(_is_news)

OPTIONS: Mapping[str, Any] = {
    "create_connection": Bounded,
    "max_size": MAX_MESSAGE,
    "open_timeout": OPEN_TIMEOUT,
    "close_timeout": CLOSE_TIMEOUT,
    "logger": _connection_log,
    "server_header": None,
}
