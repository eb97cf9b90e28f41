"""A viser server behind the access checks of the page.

`RequestGate` checks each HTTP request before viser sees it, and sends the files of the page itself. There is no proxy
process and no second listening port that would bypass the checks.
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
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server as websocket_server
from websockets import Data, Headers
from websockets.exceptions import WebSocketException
from websockets.http11 import Request, Response
from websockets.protocol import State

from common.errors import ConfigError
from common.time_source import monotonic
from common.transport.endpoint import peer_group
from page.access import CURRENT_SESSION, Access, Answer, PageSession, Permissions, gateways
from page.address import is_loopback, listen_error, open_socket
from page.viser_client import ClientFile, client_files
from page.viser_inside import (
    CONTROL_PATH,
    RequestCheck,
    SocketHandler,
    create_server,
    filter_messages,
    silence_console,
)
from security.page_tokens import MIN_TOKEN_LENGTH, TOKEN_PATTERN, TOKEN_VARIABLE

log = logging.getLogger(__name__)

MAX_PAGES = 24  # open at the same time
MAX_VIEWERS = 16  # of these for sessions that may only look, so that operators always find room
MAX_MESSAGE_RATE = 100  # messages per second, and in a burst, from each connection; dragging sends fewer
MAX_WAITING = 512  # connections that are no open page: silent ones, and those that receive a file
ACCEPTED_AT_ONCE = 32  # fewer than MAX_WAITING: requests are read in between
BACKLOG = 1024  # connections that wait to be accepted
MAX_MESSAGE_SIZE = 4 * 2**20  # [bytes] from a browser
OPEN_TIMEOUT = 5.0  # [s] until a connection has sent its request
CLOSE_TIMEOUT = 0.5  # [s] for the closing handshake of a browser
STOP_TIMEOUT = 1.5  # [s] for stopping the server; viser alone would wait 6 s

# The page loads nothing from other hosts and cannot be put into a frame of another page.
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; media-src data: blob:; font-src 'self' data:; worker-src 'self' blob:; "
    "connect-src 'self' {own} data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def make_server(
    host: str, port: int, token: str = "", *, published: bool = False, secured: bool = False,
    tokens: Mapping[str, str] | None = None, permissions: Permissions | None = None,
    control: SocketHandler | None = None,
) -> viser.ViserServer:
    """Return a running page server that rejects foreign origins, foreign host names and missing tokens.

    Args:
        host: listening address or name; an address that other machines reach requires a token.
        port: TCP port; 0: any free port (`server.get_port()`).
        token: grants all roles; empty: `ZENCELL_VIEWER_TOKEN`. Without any token none is required.
        published: the port is published by a container engine on the loopback of the host only. Requests from the
            gateway then need no token, and only loopback names are served.
        secured: require a token, whatever the listening address is.
        tokens: further tokens by role.
        permissions: decide which messages of a browser are executed, if a token is required.
        control: handles the control socket of each page; without it that socket is closed at once.

    Raises:
        ConfigError: the port is in use (names the process), the host is no address of this machine, or the token is
            missing or too short.
    """
    token = token or os.environ.get(TOKEN_VARIABLE, "")
    _check_token("127.0.0.1" if published else host, token, secured, bool(tokens))
    try:
        listening = open_socket(host, port)
    except OSError as error:
        raise listen_error(error, host, port) from None
    access = Access("127.0.0.1" if published else host, listening.getsockname()[1], token, tokens or {},
                    gateways() if published else frozenset())
    gate = RequestGate(access, permissions)
    server = create_server(listening, gate.wrap, WEBSOCKET_OPTIONS, control or _close_at_once)
    listening.listen(BACKLOG)  # asyncio also accepts as many connections at once as its backlog
    if permissions is not None:
        permissions.enforced = access.requires_token

    def allowed(element: str, value: object) -> bool:
        return permissions is None or permissions.allow(CURRENT_SESSION.get(), element, value)

    filter_messages(server, allowed)
    if not (published or is_loopback(host)):
        log.warning(
            "the page is reachable from other machines, without encryption; `ssh -L %d:127.0.0.1:%d HOST` to a page on "
            "127.0.0.1 is safer", access.port, access.port)
    return server


async def _close_at_once(connection: websocket_server.ServerConnection) -> None:
    """Return, which closes the connection."""


def close_server(server: viser.ViserServer) -> None:
    """Close all pages and stop listening; after `STOP_TIMEOUT` the rest continues in the background."""
    stopping = threading.Thread(target=server.stop, daemon=True)
    with silence_console():
        stopping.start()
        stopping.join(STOP_TIMEOUT)
    if stopping.is_alive():
        log.warning("not all pages were closed within %g s", STOP_TIMEOUT)


def _check_token(host: str, token: str, secured: bool, has_role_tokens: bool) -> None:
    if secured and not (token or has_role_tokens):
        raise ConfigError("services.viewer.token", ..., f"is needed in a secured cell, as {TOKEN_VARIABLE} in the "
                          "environment; `zencell secure init DIR --renew` creates one for each role")
    if not (token or has_role_tokens or is_loopback(host)):
        raise ConfigError(
            "services.viewer.token", ..., f"is needed for a page at {host}, as {TOKEN_VARIABLE} in the environment")
    if token and not TOKEN_PATTERN.fullmatch(token):
        raise ConfigError(
            "services.viewer.token", ..., f"must have {MIN_TOKEN_LENGTH} or more of the characters A-Z a-z 0-9 - . _ ~")


class RequestGate:
    """Admits or rejects HTTP requests, and creates the session of each WebSocket."""

    def __init__(self, access: Access, permissions: Permissions | None = None) -> None:
        """Apply these access rules; closed sessions are reported to the permissions."""
        self.access = access
        self._permissions = permissions
        self._numbers = itertools.count(1)
        self._viewers: Counter[bool] = Counter()  # sessions that may only look, by whether it is a control socket
        self._closing: set[asyncio.Task[None]] = set()

    def wrap(self, viser_check: RequestCheck) -> RequestCheck:
        """Return the request check to use instead of viser's, which then sees admitted requests only."""

        async def check(connection: websocket_server.ServerConnection, request: Request) -> Response | None:
            headers = {name: request.headers.get_all(name) for name in ("host", "origin", "cookie")}
            path, upgrade = urlsplit(request.path).path, "upgrade" in request.headers
            peer = str((connection.remote_address or ("",))[0])
            answer = self.access.check(request.path, headers, upgrade=upgrade, peer=peer)
            if isinstance(connection, BoundedConnection):
                connection.admitted = answer is None
            if answer is None and upgrade:
                answer = self._open_session(connection, path == CONTROL_PATH, peer, headers["cookie"])
            if answer is not None:
                if answer.status is not HTTPStatus.OK:
                    log.debug("rejected %s: %s", connection.remote_address, answer.text)
                return _protect(_response(answer), headers["host"])
            file = None if upgrade else client_files().get(path)
            if file is not None:
                return _protect(_file_response(file, request), headers["host"], immutable=file.immutable)
            response = viser_check(connection, request)
            if inspect.isawaitable(response):
                response = await response
            return None if response is None else _protect(response, headers["host"])

        return check

    def _open_session(
        self, connection: websocket_server.ServerConnection, control: bool, peer: str, cookies: list[str]
    ) -> Answer | None:
        """Set the session of this task and of all tasks it starts; return an answer if too many pages are open."""
        roles = self.access.roles(cookies)
        view_only = "operate" not in roles
        full = _count(connection.server.connections, control) >= MAX_PAGES
        if full or (view_only and self._viewers[control] >= MAX_VIEWERS):
            limit = MAX_PAGES if full else MAX_VIEWERS
            return Answer(HTTPStatus.SERVICE_UNAVAILABLE, f"{limit} pages are open already: close one\n")
        session = PageSession(0 if control else next(self._numbers), peer, roles)
        self._viewers[control] += view_only
        CURRENT_SESSION.set(session)
        closing = asyncio.create_task(self._close_session(connection, session, control))
        self._closing.add(closing)
        closing.add_done_callback(self._closing.discard)
        return None

    async def _close_session(
        self, connection: websocket_server.ServerConnection, session: PageSession, control: bool
    ) -> None:
        await connection.wait_closed()
        self._viewers[control] -= "operate" not in session.roles
        if self._permissions is not None:
            self._permissions.remove(session)


def _count(connections: Iterable[websocket_server.ServerConnection], control: bool) -> int:
    """Return the number of control sockets, or of other connections."""
    paths = [urlsplit(each.request.path).path for each in connections if each.request is not None]
    return sum((path == CONTROL_PATH) == control for path in paths)


class BoundedConnection(websocket_server.ServerConnection):
    """A connection with a message rate limit; beyond `MAX_WAITING` the oldest of the address with the most is ended."""

    admitted = False  # whether its request passed all checks
    _budget, _last = 0.0, 0.0
    _peer = ""

    async def recv(self, decode: bool | None = None) -> Data:  # type: ignore[override]
        """Return the next message; delay it beyond the rate limit, so that a flood does not delay other pages."""
        data = await super().recv(decode)
        now = monotonic()
        self._budget = min(self._budget + MAX_MESSAGE_RATE * (now - self._last), MAX_MESSAGE_RATE) - 1
        self._last = now
        if self._budget < 0:
            await asyncio.sleep(-self._budget / MAX_MESSAGE_RATE)
        return data

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start, and make room among the connections that are no open page."""
        super().connection_made(transport)
        self._peer = peer_group(str((self.remote_address or ("::",))[0]))
        waiting = [each for each in self.server.handlers if isinstance(each, BoundedConnection)
                   and each.state is not State.OPEN and not each.transport.is_closing()]
        if len(waiting) > MAX_WAITING:
            strangers = [each for each in waiting if not each.admitted] or waiting
            counts = Counter(each._peer for each in strangers)
            most = max(counts.values())
            next(each for each in strangers if counts[each._peer] == most).transport.abort()


# --- responses ---


def _response(answer: Answer) -> Response:
    body = answer.text.encode()
    headers = Headers(answer.headers)
    headers["Content-Type"] = "text/html; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(answer.status.value, answer.status.phrase, headers, body)


def _file_response(file: ClientFile, request: Request) -> Response:
    """Return a file of the page, compressed if the browser accepts it."""
    headers = Headers({"Content-Type": file.media_type, "Vary": "Accept-Encoding", "Connection": "close"})
    body = file.body
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        headers["Content-Encoding"] = "gzip"
    else:
        body = gzip.decompress(body)
    headers["Content-Length"] = str(len(body))
    return Response(HTTPStatus.OK.value, HTTPStatus.OK.phrase, headers, body)


def _protect(response: Response, hosts: list[str], *, immutable: bool = False) -> Response:
    """Add the security and cache headers."""
    # Safari before 15.4 does not accept 'self' for a WebSocket. The host name was checked if the status is 200.
    own = f"ws://{hosts[0]} wss://{hosts[0]}" if response.status_code == HTTPStatus.OK and len(hosts) == 1 else ""
    response.headers["Content-Security-Policy"] = CONTENT_SECURITY_POLICY.format(own=own)
    response.headers["X-Content-Type-Options"] = "nosniff"
    response.headers["Referrer-Policy"] = "no-referrer"
    response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    response.headers["Cache-Control"] = "private, max-age=31536000, immutable" if immutable else "no-store"
    return response


# --- WebSocket options ---


def _filter_log(record: logging.LogRecord) -> bool:
    """Drop failed handshakes from the log, and the traceback of protocol errors, which are faults of the client."""
    if record.getMessage() == "opening handshake failed":
        return False
    if record.exc_info and isinstance(error := record.exc_info[1], WebSocketException):
        record.msg, record.args, record.exc_info = f"{record.getMessage()}: {error}", (), None
    return True


_connection_log = logging.getLogger(f"{__name__}.connections")
_connection_log.setLevel(logging.WARNING)
_connection_log.addFilter(_filter_log)

WEBSOCKET_OPTIONS: Mapping[str, Any] = {
    "create_connection": BoundedConnection,
    "max_size": MAX_MESSAGE_SIZE,
    "open_timeout": OPEN_TIMEOUT,
    "close_timeout": CLOSE_TIMEOUT,
    "backlog": ACCEPTED_AT_ONCE,
    "logger": _connection_log,
    "server_header": None,
}
