"""Access to the page: checks of HTTP requests (Host, Origin, access token), and permissions of open pages.

The page commands a robot, and a browser lets every web page talk to the machine it runs on. So requests that another
web page caused (its Origin differs from our Host) are rejected. Requests for a foreign host name are rejected too: DNS
rebinding can point a foreign name at this machine, and its pages would then count as our origin.

Roles come from the access token, and one page at a time operates the robot. Without access tokens every page may do
everything. Every page may stop the robot.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from typing import Literal
from urllib.parse import parse_qs, urlsplit

from common.time_source import monotonic
from page.address import is_loopback, page_url, parse_address
from security.page_tokens import ALL_ROLES, TOKEN_VARIABLE

_AUTHORITY = re.compile(r"(?P<host>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:(?P<port>\d{1,5}))?", re.IGNORECASE)
_DEFAULT_PORTS = {"http": 80, "https": 443}


@dataclass(frozen=True)
class Answer:
    """The reply to a request that does not get the page."""

    status: HTTPStatus
    text: str  # HTML
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Access:
    """Access rules of one page.

    Attributes:
        host: listening address.
        port: listening TCP port.
        token: grants all roles; empty: none.
        tokens: token of each role. Without `token` and `tokens` no token is required.
        trusted_peers: peer addresses that count as this machine, in addition to the loopback.
    """

    host: str
    port: int
    token: str = field(default="", repr=False)
    tokens: Mapping[str, str] = field(default_factory=dict, repr=False)
    trusted_peers: frozenset[str] = frozenset()

    def check(
        self, path: str, headers: Mapping[str, Sequence[str]], *, upgrade: bool, peer: str = "127.0.0.1"
    ) -> Answer | None:
        """Return None for an admitted request, else a rejection or the cookie for the token in the query.

        Args:
            path: of the request, with its query.
            headers: all values of `host`, `origin` and `cookie`.
            upgrade: whether the request opens a WebSocket.
            peer: address at the other end of the connection; unlike a header it cannot be forged.
        """
        hosts, origins = headers.get("host", ()), headers.get("origin", ())
        host = _split_authority(hosts[0]) if len(hosts) == 1 else None
        if host is None or not self._is_our_name(host[0]):
            return _reject(HTTPStatus.FORBIDDEN, f"this page is not served under that name; open {self.address}")
        if any(not _same_origin(origin, host) for origin in origins):
            return _reject(HTTPStatus.FORBIDDEN, "other web pages must not access this page")
        if not self.requires_token:
            return None if self._is_local(peer) else _reject(
                HTTPStatus.UNAUTHORIZED,
                f"this page is open to its own machine only: set {TOKEN_VARIABLE} to allow other machines")
        if self.roles(headers.get("cookie", ())):
            return None
        tokens = parse_qs(urlsplit(path).query).get("token", [])
        if not tokens or not self._roles_of(tokens[0]):
            return _reject(HTTPStatus.UNAUTHORIZED, "this page requires a token: open the address with ?token=...")
        return None if upgrade else self._set_cookie(tokens[0])

    @property
    def address(self) -> str:
        """URL of the page, without the token."""
        return page_url(self.host, self.port)

    @property
    def requires_token(self) -> bool:
        """Whether a token is required."""
        return bool(self.token or self.tokens)

    def roles(self, cookies: Sequence[str]) -> frozenset[str]:
        """Return the roles that these `cookie` headers grant; all roles if no token is required."""
        if not self.requires_token:
            return ALL_ROLES
        pairs = [part.strip().partition("=") for header in cookies for part in header.split(";")]
        return frozenset().union(*(
            self._roles_of(value, self._cookie_of) for name, _, value in pairs if name == self._cookie))

    def _roles_of(self, secret: str, derive: Callable[[str], str] = str) -> frozenset[str]:
        """Return the roles of the tokens from which `derive` makes a secret; none for an unknown secret."""
        found = {role for role, known in self.tokens.items() if _equal(secret, derive(known))}
        if self.token and _equal(secret, derive(self.token)):
            found |= ALL_ROLES
        return frozenset(found | {"look"}) if found else frozenset()

    def _cookie_of(self, token: str) -> str:
        return cookie_value(token, self.port)

    @property
    def _cookie(self) -> str:
        return f"zencell-{self.port}"  # a browser shares cookies between all ports of a host

    def _set_cookie(self, token: str) -> Answer:
        # Not a redirect: after a link in a mail, a redirect would not carry a SameSite=Strict cookie yet.
        return Answer(
            HTTPStatus.OK,
            '<!doctype html><meta charset="utf-8"><title>zencell</title><script>location.replace("/")</script>',
            {"Set-Cookie": f"{self._cookie}={self._cookie_of(token)}; Path=/; HttpOnly; SameSite=Strict"},
        )

    def _is_our_name(self, name: str) -> bool:
        if is_loopback(name) or name == self.host.lower():
            return True
        if is_loopback(self.host):
            return False
        # DNS rebinding needs a name: any address is fine, a name must be that of this machine.
        return parse_address(name) is not None or name in _machine_names()

    def _is_local(self, peer: str) -> bool:
        address = parse_address(peer.partition("%")[0])
        mapped = getattr(address, "ipv4_mapped", None) or address
        return mapped is not None and (mapped.is_loopback or str(mapped) in self.trusted_peers)


def cookie_value(token: str, port: int) -> str:
    """Return the value of a page's cookie, which proves the token without revealing it and fits no other port.

    A browser sends a cookie to every server of the same host, whatever its port.
    """
    return hmac.new(token.encode("utf-8", "replace"), f"zencell page {port}".encode(), hashlib.sha256).hexdigest()


def gateways(table: Path = Path("/proc/net/route")) -> frozenset[str]:
    """Return the default gateways: a container engine forwards published ports from there."""
    try:
        rows = [line.split() for line in table.read_text(encoding="ascii").splitlines()[1:]]
    except OSError:
        return frozenset()
    found = (bytes.fromhex(row[2])[::-1] for row in rows if len(row) > 2 and row[1] == "00000000")
    return frozenset(str(ipaddress.IPv4Address(address)) for address in found)


def _reject(status: HTTPStatus, reason: str) -> Answer:
    return Answer(status, f'<!doctype html><meta charset="utf-8"><title>{status.phrase}</title>{reason}\n')


def _equal(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode("utf-8", "replace"))


def _split_authority(authority: str) -> tuple[str, int | None] | None:
    """Return host and port of `host:port`; None if the text has another form."""
    match = _AUTHORITY.fullmatch(authority.strip())
    return (match["host"].lower(), int(match["port"]) if match["port"] else None) if match else None


def _same_origin(origin: str, host: tuple[str, int | None]) -> bool:
    scheme, _, rest = origin.strip().partition("://")
    default = _DEFAULT_PORTS.get(scheme.lower())
    parts = _split_authority(rest)
    if default is None or parts is None:
        return False
    return (parts[0], parts[1] or default) == (host[0], host[1] or default)


def _machine_names() -> set[str]:
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return {name, short, f"{short}.local"}


Permission = Literal["stop", "look", "operate", "tune", "take"]  # take: become the operating page

PAGE = "page"  # name of the client where pages are not distinguished
OPERATE_TIMEOUT = 60.0  # [s] without an operation, after which the operating page loses control
LOG_INTERVAL = 2.0  # [s] between log lines for the same control, such as a slider that is dragged
MAX_LOGGED_VALUE = 60  # characters


@dataclass(frozen=True)
class PageSession:
    """One open page, for as long as its connection exists."""

    number: int  # 0: a control socket that has not identified its page yet
    address: str
    roles: frozenset[str]

    def __str__(self) -> str:
        """Return the name for labels and log lines."""
        return f"page {self.number} ({', '.join(sorted(self.roles - {'look'})) or 'look'}, {self.address})"


CURRENT_SESSION: ContextVar[PageSession | None] = ContextVar("session", default=None)  # that sent the current message


class Permissions:
    """Decides what each page may do. Thread-safe.

    Attributes:
        enforced: whether access tokens are required; otherwise everything is allowed.
        on_denied: called with the reason when something is denied.
    """

    def __init__(self, log: Callable[[str], None] = lambda line: None) -> None:
        """Allow everything until `enforced` is set; operations are logged by `log`."""
        self.enforced = False
        self.on_denied: Callable[[str], None] = lambda reason: None
        self._log = log
        self._required: dict[str, tuple[Permission, str]] = {}  # with the label, by element id
        self._operating: PageSession | None = None
        self._last_operation = 0.0  # [s, monotonic]
        self._last_logged: dict[tuple[PageSession | None, str], float] = {}
        self._sessions: dict[str, PageSession] = {}  # by secret key
        self._lock = threading.Lock()

    def require(self, element: str, permission: Permission, label: str) -> None:
        """Set the permission that an element of the page requires; by default it is "operate"."""
        self._required[element] = (permission, label)

    def forget(self, element: str) -> None:
        """Forget an element that was removed from the page."""
        self._required.pop(element, None)

    # --- sessions ---

    def issue_key(self, session: PageSession) -> str:
        """Return a secret key by which the control socket of the same page identifies itself."""
        key = secrets.token_urlsafe(16)
        with self._lock:
            self._sessions[key] = session
        return key

    def session_of(self, key: str) -> PageSession | None:
        """Return the session that has this key while its page is open."""
        with self._lock:
            return self._sessions.get(key)

    def is_open(self, session: PageSession | None) -> bool:
        """Return whether the page of a session is open and has a key."""
        with self._lock:
            return session in self._sessions.values()

    def remove(self, session: PageSession | None) -> None:
        """Forget a closed page; it no longer operates."""
        with self._lock:
            self._last_logged = {known: when for known, when in self._last_logged.items() if known[0] != session}
            self._sessions = {key: known for key, known in self._sessions.items() if known != session}
            if session is not None and session == self._operating:
                self._operating = None
                self._log(f"{session} was closed and no longer operates")

    # --- control ---

    @property
    def client_name(self) -> str:
        """Owner name for requests of the current session: pages of one host share it, as one operator uses them."""
        session = CURRENT_SESSION.get()
        return f"{PAGE} {session.address}" if self.enforced and session is not None else PAGE

    @property
    def operating_page(self) -> str:
        """The page that operates; empty if none does."""
        with self._lock:
            active = self._operating is not None and monotonic() - self._last_operation < OPERATE_TIMEOUT
            return str(self._operating) if active else ""

    def release(self, session: PageSession | None) -> bool:
        """End the control of a page; return whether it had control."""
        with self._lock:
            had_control = session is not None and session == self._operating
            if had_control:
                self._operating = None
                self._log(f"{session} no longer operates")
        return had_control

    def allow(self, session: PageSession | None, element: str, value: object = None) -> bool:
        """Return whether a session may use an element of the page; log the use, or report the reason."""
        if not self.enforced:
            return True
        permission, label = self._required.get(element, ("operate", "moves an object in the scene"))
        with self._lock:
            reason = self._deny_reason(session, permission)
            if not reason and permission != "look":
                self._log_use(session, label, value)
        if reason:
            self.on_denied(reason)
        return not reason

    def check(self, session: PageSession | None, permission: Permission) -> str:
        """Return why a session lacks a permission; empty if it has it, or would get it by using it."""
        if not self.enforced:
            return ""
        with self._lock:
            return self._deny_reason(session, permission, claim=False)

    def _deny_reason(self, session: PageSession | None, permission: Permission, *, claim: bool = True) -> str:
        if permission in ("stop", "look"):
            return ""
        role = "operate" if permission == "take" else permission
        if session is None or role not in session.roles:
            return f"{session or 'This page'} has no token for the role {role!r}"
        if permission == "tune":
            return ""
        now, before = monotonic(), self._operating
        free = before is None or before == session or now - self._last_operation >= OPERATE_TIMEOUT
        if not free and permission != "take":
            return f"{before} has control: press Take page control, or wait until it is released"
        if not claim:
            return ""
        if before != session:
            self._log(f"{session} operates" + (f" instead of {before}" if before is not None else ""))
        self._operating, self._last_operation = session, now
        return ""

    def _log_use(self, session: PageSession | None, label: str, value: object) -> None:
        now = monotonic()
        if now - self._last_logged.get((session, label), -LOG_INTERVAL) >= LOG_INTERVAL:
            shown = "" if value is None else f": {value!r}"[:MAX_LOGGED_VALUE]
            self._log(f"{session}: {label}{shown}")
        self._last_logged[session, label] = now
