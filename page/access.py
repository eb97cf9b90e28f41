"""Where the page listens, and who may open it: what is asked of Host, Origin and token of a request.

The page commands a robot, and a browser lets every web page that it shows talk to the machine it runs on. So a request
that another page caused (its Origin is not our Host) is refused, and so is one for a name that is not ours: a foreign
name can be made to point at this machine (DNS rebinding), and its pages would then be of our origin.
"""

from __future__ import annotations

import errno
import hmac
import ipaddress
import re
import secrets
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from common.errors import ConfigError

VIEWER = "viewer"  # kind of the service that serves the page
FIRST_PORT = 8080  # when none is asked for
LAST_PORT = FIRST_PORT + 99
TOKEN_VARIABLE = "ZENCELL_VIEWER_TOKEN"  # in the environment, where no list of processes shows it
SHORTEST_TOKEN = 16  # characters
ROLES = ("look", "operate", "tune")  # what a token is for: nothing but looking, moving, changing parameters
EVERYTHING = frozenset(ROLES)
TOKEN = re.compile(rf"[A-Za-z0-9._~-]{{{SHORTEST_TOKEN},}}")  # what needs no escaping in an address or a cookie

_AUTHORITY = re.compile(r"(?P<host>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:(?P<port>\d{1,5}))?", re.IGNORECASE)
_DEFAULT_PORTS = {"http": 80, "https": 443}


def token_file(folder: Path, cell: str, role: str) -> Path:
    """Where the token of a role at the page of a secured cell is kept."""
    return folder / f"{cell}.page.{role}"


def tokens_in(folder: Path, cell: str) -> dict[str, str]:
    """The tokens of a secured cell's page by role, as far as they are there.

    Raises:
        ConfigError: others can read one of them, or it is none.
    """
    found = {}
    for role in ROLES:
        path = token_file(folder, cell, role)
        if not path.is_file():
            continue
        if path.stat().st_mode & 0o077:
            raise ConfigError("--secure", str(path), "can be read by others: chmod 600 it")
        try:
            found[role] = path.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError("--secure", str(path), f"cannot be read: {error}") from None
        if not TOKEN.fullmatch(found[role]):
            raise ConfigError("--secure", str(path), "holds no token: `zencell secure init DIR --renew` makes one")
    return found


def gateways(table: Path = Path("/proc/net/route")) -> frozenset[str]:
    """Addresses from which what was published by the engine of a container comes in: those of default routes."""
    try:
        rows = [line.split() for line in table.read_text(encoding="ascii").splitlines()[1:]]
    except OSError:
        return frozenset()
    found = (bytes.fromhex(row[2])[::-1] for row in rows if len(row) > 2 and row[1] == "00000000")
    return frozenset(str(ipaddress.IPv4Address(address)) for address in found)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address to listen at; a name other than localhost never counts as that."""
    address = _address(host)
    return host.lower() == "localhost" if address is None else address.is_loopback


def make_token() -> str:
    """A token that nobody guesses: 256 bits, in characters that need no escaping in an address."""
    return secrets.token_urlsafe(32)


@dataclass(frozen=True)
class Answer:
    """What a request gets instead of the page."""

    status: HTTPStatus
    text: str  # HTML
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Access:
    """The rules of one page."""

    host: str  # that it listens at
    port: int
    token: str = field(default="", repr=False)  # for operating and tuning
    tokens: Mapping[str, str] = field(default_factory=dict, repr=False)  # by role; without any, none is asked for
    near: frozenset[str] = frozenset()  # addresses beside the loopback's that count as this machine

    def answer(
        self, path: str, headers: Mapping[str, Sequence[str]], *, upgrade: bool, peer: str = "127.0.0.1"
    ) -> Answer | None:
        """None for a request that may pass; else what it gets: a refusal, or the cookie for the token it brought.

        Args:
            path: of the request, with its query.
            headers: values of `host`, `origin` and `cookie`, each as often as it was sent.
            upgrade: whether a WebSocket is asked for.
            peer: address at the other end of the connection. What a request says of itself anybody can say.
        """
        hosts, origins = headers.get("host", ()), headers.get("origin", ())
        host = _parts(hosts[0]) if len(hosts) == 1 else None
        if host is None or not self._is_ours(host[0]):
            return _refusal(HTTPStatus.FORBIDDEN, f"this page is not served under that name; open {self.address}")
        if any(not _same_origin(origin, host) for origin in origins):
            return _refusal(HTTPStatus.FORBIDDEN, "this page is not open to other web pages")
        if not self.asks:
            return None if self._is_near(peer) else _refusal(
                HTTPStatus.UNAUTHORIZED, f"this page is for its own machine: set {TOKEN_VARIABLE} for others")
        if self.roles(headers.get("cookie", ())):
            return None
        given = parse_qs(urlsplit(path).query).get("token", [])
        if not given or not self._roles_of(given[0]):
            return _refusal(HTTPStatus.UNAUTHORIZED, "this page needs its token: open the address with ?token=...")
        return None if upgrade else self._welcome(given[0])

    @property
    def address(self) -> str:
        """What a person opens, without the token."""
        return address_of(self.host, self.port)

    @property
    def _cookie(self) -> str:
        return f"zencell-{self.port}"  # a browser keeps one jar for all ports of a host

    def _is_ours(self, name: str) -> bool:
        if is_loopback(name) or name == self.host.lower():
            return True
        if is_loopback(self.host):
            return False
        # An address cannot be rebound; a name must be this machine's own.
        return _address(name) is not None or name in _own_names()

    @property
    def asks(self) -> bool:
        """Whether a token is needed."""
        return bool(self.token or self.tokens)

    def _is_near(self, peer: str) -> bool:
        address = _address(peer.partition("%")[0])
        mapped = getattr(address, "ipv4_mapped", None) or address
        return mapped is not None and (mapped.is_loopback or str(mapped) in self.near)

    def _roles_of(self, given: str) -> frozenset[str]:
        """What a token is for; nothing, if it is none of ours."""
        found = {role for role, token in self.tokens.items() if _equal(given, token)}
        if self.token and _equal(given, self.token):
            found |= EVERYTHING
        return frozenset(found | {"look"}) if found else frozenset()

    def roles(self, cookies: Sequence[str]) -> frozenset[str]:
        """What somebody may do who brings these cookies; everything, where no token is asked for."""
        if not self.asks:
            return EVERYTHING
        pairs = [part.strip().partition("=") for header in cookies for part in header.split(";")]
        return frozenset().union(*(self._roles_of(value) for name, _, value in pairs if name == self._cookie))

    def _welcome(self, token: str) -> Answer:
        # Not a redirect: coming from a link in a mail, that would not carry a SameSite=Strict cookie yet.
        return Answer(
            HTTPStatus.OK,
            '<!doctype html><meta charset="utf-8"><title>zencell</title><script>location.replace("/")</script>',
            {"Set-Cookie": f"{self._cookie}={token}; Path=/; HttpOnly; SameSite=Strict"},
        )


def address_of(host: str, port: int) -> str:
    """What a person opens for a page that listens at host and port."""
    address = _address(host)
    if address is not None and address.is_unspecified:
        host = _outward_address()
    shown = f"[{host.strip('[]')}]" if ":" in host else host
    return f"http://{shown}:{port}"


def _refusal(status: HTTPStatus, why: str) -> Answer:
    return Answer(status, f'<!doctype html><meta charset="utf-8"><title>{status.phrase}</title>{why}\n')


def _equal(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "replace"), token.encode("utf-8", "replace"))


def _parts(authority: str) -> tuple[str, int | None] | None:
    """Host and port of `host:port`; None for what is not of that form."""
    match = _AUTHORITY.fullmatch(authority.strip())
    return (match["host"].lower(), int(match["port"]) if match["port"] else None) if match else None


def _same_origin(origin: str, host: tuple[str, int | None]) -> bool:
    scheme, _, rest = origin.strip().partition("://")
    default = _DEFAULT_PORTS.get(scheme.lower())
    parts = _parts(rest)
    if default is None or parts is None:
        return False
    return (parts[0], parts[1] or default) == (host[0], host[1] or default)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return None


def _own_names() -> set[str]:
    name = socket.gethostname().lower()
    short = name.partition(".")[0]
    return {name, short, f"{short}.local"}


def _outward_address() -> str:
    """An address of this machine under which others may reach it; 127.0.0.1 when it has none."""
    import psutil

    for addresses in psutil.net_if_addrs().values():
        for found in addresses:
            if found.family == socket.AF_INET and not is_loopback(found.address):
                return found.address
    return "127.0.0.1"


# --- the socket ---


def open_socket(host: str, port: int) -> socket.socket:
    """A socket that listens at host and port (0: any that is free).

    Raises:
        OSError: it cannot.
    """
    if host.lower() == "localhost":
        host = "127.0.0.1"  # a browser that tries ::1 first comes back to it
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, _, _, _, address = found[0]
    both = family == socket.AF_INET6 and host == str(ipaddress.IPv6Address(0)) and socket.has_dualstack_ipv6()
    return socket.create_server(address[:2], family=family, dualstack_ipv6=both)


def refusal(error: OSError, host: str, port: int, field: str = "") -> ConfigError:
    """What to tell the person who asked for a host and port that cannot be listened at.

    Args:
        error: from `open_socket`.
        host: as it was asked for.
        port: as it was asked for.
        field: the option that named the port; by default the parameter of the viewer.
    """
    if error.errno == errno.EADDRINUSE:
        from common.transport.router import port_holder

        return ConfigError(field or "services.viewer.port", port, f"is in use by {port_holder(port)}")
    if error.errno == errno.EACCES:
        return ConfigError(field or "services.viewer.port", port, "may not be used by this user; take 1024 or more")
    reason = error.strerror or str(error)
    return ConfigError("services.viewer.host", host, f"cannot be listened at: {reason}")


class FreePort:
    """A port that nobody else who starts a cell takes before its page is there, for as long as this object lives."""

    def __init__(self, number: int) -> None:
        """Claim the port.

        Raises:
            OSError: somebody else has.
        """
        self.number = number
        self._claim: socket.socket | None = None
        if sys.platform == "linux":  # a name that vanishes with its process; elsewhere two at once may meet
            self._claim = socket.socket(socket.AF_UNIX)
            try:
                self._claim.bind(f"\0zencell-page-{number}")
            except OSError:
                self._claim.close()
                raise

    def __del__(self) -> None:
        """Let go of it."""
        if self._claim is not None:
            self._claim.close()


def first_free_port(host: str) -> FreePort:
    """The first port from 8080 on that can be listened at.

    Raises:
        ConfigError: none can, or the host is none of this machine's.
    """
    for number in range(FIRST_PORT, LAST_PORT + 1):
        try:
            port = FreePort(number)
            open_socket(host, number).close()
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise refusal(error, host, number) from None
            continue
        return port
    raise ConfigError("--viewer-port", ..., f"ports {FIRST_PORT} to {LAST_PORT} are all in use; name another")
