"""Checks on the HTTP requests for the page: Host, Origin and access token.

The page commands a robot, and a browser lets every web page talk to the machine it runs on. So requests that another
web page caused (its Origin differs from our Host) are rejected. Requests for a foreign host name are rejected too: DNS
rebinding can point a foreign name at this machine, and its pages would then count as our origin.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

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
        return frozenset().union(*(self._roles_of(value) for name, _, value in pairs if name == self._cookie))

    def _roles_of(self, token: str) -> frozenset[str]:
        """Return the roles that a token grants; none for an unknown token."""
        found = {role for role, known in self.tokens.items() if _equal(token, known)}
        if self.token and _equal(token, self.token):
            found |= ALL_ROLES
        return frozenset(found | {"look"}) if found else frozenset()

    @property
    def _cookie(self) -> str:
        return f"zencell-{self.port}"  # a browser shares cookies between all ports of a host

    def _set_cookie(self, token: str) -> Answer:
        # Not a redirect: after a link in a mail, a redirect would not carry a SameSite=Strict cookie yet.
        return Answer(
            HTTPStatus.OK,
            '<!doctype html><meta charset="utf-8"><title>zencell</title><script>location.replace("/")</script>',
            {"Set-Cookie": f"{self._cookie}={token}; Path=/; HttpOnly; SameSite=Strict"},
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
