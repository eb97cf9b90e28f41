"""The router of a domain: the session that all services of a host are clients of."""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import os
import socket
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import zenoh

from common.errors import ConfigError, ZencellError
from common.transport.credentials import (
    ACCESS,
    AUTHORITY,
    OBSERVER,
    OPERATOR,
    ROUTER_NAME,
    Credentials,
    credentials_of,
    read_access,
    require_pair,
)
from common.transport.endpoint import address_of, client_config, is_encrypted, port_of, router_config
from common.transport.inner_certificates import InnerAuthority
from common.transport.tls_gate import TlsGate

log = logging.getLogger("router")

_CHECK_SECONDS = 0.5  # between two checks of the links with other routers
PER_CERTIFICATE = 16  # of a service's certificate: it restarts, and its previous session may last for a while
MAX_TOOLS = 100  # of a certificate that all tools, or the routers of all hosts, share
SHARED_CERTIFICATES = (OPERATOR, OBSERVER, ROUTER_NAME)
LOG_SECONDS = 60.0  # between two log lines about a certificate


class PortInUse(ZencellError):
    """Another process listens at the router's endpoint."""

    def __init__(self, endpoint: str, holder: str) -> None:
        port = int(endpoint.rpartition(":")[2])
        super().__init__(
            f"port {port} (domain {port - port_of(0)}) is in use by {holder}; stop it or choose another --domain"
        )
        self.port = port
        self.holder = holder


def port_holder(port: int) -> str:
    """Return the process that listens on a TCP port of this host, as far as the system shows it."""
    import psutil  # slow to import: health checks start often

    try:
        found = [c.pid for c in psutil.net_connections("tcp")
                 if c.status == psutil.CONN_LISTEN and c.laddr and c.laddr.port == port and c.pid]
        if found:
            process = psutil.Process(found[0])
            return f"process {process.pid} ({' '.join(process.cmdline()) or process.name()})"
    except psutil.Error as error:
        log.debug("holder of port %d: %s", port, error)
    return "another process"


class Router:
    """A router as of `open_router`; a secured one is behind a TLS gate and can reload certificates. A `with` block."""

    def __init__(
        self, endpoints: Sequence[str], secured: Path | None = None, links: Sequence[str] = (),
        small: Sequence[str] = (), near: Sequence[str] = (),
    ) -> None:
        """Listen at the endpoints; a secured router also at a `near` one without gate, the next one after a reload.

        Raises:
            PortInUse, ConfigError: as `open_router`.
        """
        self._gate: TlsGate | None = None
        self._secured, self._links, self._small = secured, links, small
        self._near = deque(near if secured is not None else ())
        self._ungated = [*endpoints]
        if secured is not None:
            _require_encrypted(endpoints, links)
            gated = [endpoint for endpoint in endpoints if endpoint.startswith("tls/")]
            self._ungated = [endpoint for endpoint in endpoints if endpoint not in gated]
            with _explain_listen_errors():
                self._gate = TlsGate(gated)
        try:
            self._files = self._seen = self._read_files()
            self.session = self._open()
        except BaseException:
            if self._gate is not None:
                self._gate.close()
            raise

    def __enter__(self) -> Router:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the session and the gate."""
        self.session.close()  # type: ignore[no-untyped-call]
        if self._gate is not None:
            self._gate.close()

    def _open(self) -> zenoh.Session:
        if self._gate is None or self._secured is None:
            return open_router(self._ungated, None, self._links, self._small)
        authority = InnerAuthority(credentials_of(ROUTER_NAME, self._secured))
        host, port = "127.0.0.1", _free_port()
        behind = [f"tls/{host}:{port}", *self._ungated]
        self._near.rotate(1)  # the previous session still listens at the previous one
        try:
            session = open_router([*behind, *[*self._near][:1]], self._secured, self._links, self._small, authority)
        except PortInUse:
            if not self._near:
                raise
            log.warning("%s is in use by %s: services of this host connect through the gate", self._near[0],
                        port_holder(address_of(self._near[0])[1]))
            session = open_router(behind, self._secured, self._links, self._small, authority)
        with _explain_listen_errors():
            self._gate.open(host, port, authority)
        return session

    def _read_files(self) -> dict[str, bytes]:
        names = (f"{AUTHORITY}.pem", f"{ROUTER_NAME}.pem", f"{ROUTER_NAME}.key", ACCESS)
        return {name: (self._secured / name).read_bytes() for name in names} if self._secured is not None else {}

    def renew(self) -> bool:
        """Reload changed certificates and rules; return whether they are in force now. All clients reconnect then.

        Call it periodically: a change counts once two calls in a row read the same files.

        Raises:
            ConfigError: the new files are unusable; the previous ones stay in force. Raised once per change.
        """
        if self._gate is None or self._ungated:
            return False
        try:
            now = self._read_files()
        except OSError:
            return False  # being replaced
        before, self._seen = self._seen, now
        if now in (self._files, {}) or now != before:
            return False
        self._files = now
        assert self._secured is not None
        require_pair(credentials_of(ROUTER_NAME, self._secured))
        read_access(self._secured)
        old, self.session = self.session, self._open()
        old.close()  # type: ignore[no-untyped-call]
        return True


@contextlib.contextmanager
def _explain_listen_errors() -> Iterator[None]:
    """Replace an OSError of the gate by one that names the endpoint and its holder, or the reason."""
    try:
        yield
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise PortInUse(error.filename, port_holder(address_of(error.filename)[1])) from None
        raise ConfigError("endpoint", error.filename, f"cannot be listened at: {error.strerror}") from None


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def _require_encrypted(endpoints: Sequence[str], links: Sequence[str]) -> None:
    for option, given in (("--listen", endpoints), ("--link", links)):
        for each in given:
            if not is_encrypted(each):
                raise ConfigError(option, each, "is an open endpoint: with certificates it must be tls/HOST:PORT")


def open_router(
    endpoints: Sequence[str], secured: Path | None = None, links: Sequence[str] = (), small: Sequence[str] = (),
    inner: InnerAuthority | None = None,
) -> zenoh.Session:
    """Open a session that routes for all clients at the endpoints, and listens nowhere else.

    Args:
        endpoints: where it listens.
        secured: folder of certificates and rules; without it every client may do everything.
        links: endpoints of routers of other hosts, which need not be up yet.
        small: further keys of small messages, without the cell.
        inner: authority of the TLS gate in front of it.

    Raises:
        PortInUse: names the port, the domain and the process that holds it.
        ConfigError: the router cannot listen there for another reason.
    """
    if secured is not None:
        _require_encrypted(endpoints, links)
    try:
        if secured is None:
            return zenoh.open(router_config(endpoints, links=links, small=small))
        credentials = inner or credentials_of(ROUTER_NAME, secured)
        return zenoh.open(router_config(endpoints, credentials, read_access(secured), links, small))
    except zenoh.ZError as error:
        text = str(error)
        endpoint = next((each for each in endpoints if each in text), endpoints[0])
        if "os error 98" in text or "in use" in text:
            raise PortInUse(endpoint, port_holder(int(endpoint.rpartition(":")[2]))) from None
        reason = text.split(" at /", maxsplit=1)[0]  # without the position in Zenoh's source
        raise ConfigError("endpoint", endpoint, f"cannot be listened at: {reason}") from None


class SessionLimits:
    """Ends sessions of a certificate that has too many: Zenoh has room for some 500 of all certificates together."""

    def __init__(self) -> None:
        """Start without a session."""
        self._known: dict[tuple[str, str], None] = {}  # certificate and remote address, oldest first
        self._logged: dict[str, float] = {}  # time of the last log line by certificate [s]

    def enforce(self, session: zenoh.Session) -> None:
        """End the newest sessions beyond the limit of their certificate."""
        links = [(link.auth_identifier, link.dst) for link in session.info.links() if link.auth_identifier]
        self._known = dict.fromkeys([*filter(set(links).__contains__, self._known), *links])
        by_certificate: dict[str, list[str]] = {}
        for certificate, remote in self._known:
            by_certificate.setdefault(certificate, []).append(remote)
        excess: set[tuple[str, int]] = set()
        for certificate, remotes in by_certificate.items():
            most = MAX_TOOLS if certificate in SHARED_CERTIFICATES else PER_CERTIFICATE
            if len(remotes) > most:
                excess.update(map(address_of, remotes[most:]))
                if time.monotonic() - self._logged.get(certificate, -math.inf) > LOG_SECONDS:
                    self._logged[certificate] = time.monotonic()
                    log.error("certificate %s has %d sessions, at most %d are allowed: the newest ones are ended",
                              certificate, len(remotes), most)
        if excess:
            _shut_down(excess)


def _shut_down(remotes: set[tuple[str, int]]) -> None:
    """Shut down this process's connections with remote addresses; Zenoh, which owns them, cannot close a session."""
    for name in os.listdir("/dev/fd"):
        with contextlib.suppress(OSError):  # not connected, or closed meanwhile
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            with socket.socket(fileno=os.dup(int(name))) as connection:
                if connection.getpeername()[:2] in remotes:
                    connection.shutdown(socket.SHUT_RDWR)


def maintain(router: Router, stop: threading.Event, check: Callable[[], None] = lambda: None) -> None:
    """Reload certificates and log which routers of other hosts are connected and lost, until stopped.

    Args:
        router: to maintain.
        stop: ends it.
        check: called periodically.
    """
    linked: set[str] = set()
    limits = SessionLimits()
    while not stop.wait(_CHECK_SECONDS):
        try:
            if router.renew():
                log.warning("new certificates or rules are in force: all clients reconnect, with their new ones")
        except ZencellError as error:
            log.error("%s; the previous ones stay in force", error)
        check()
        limits.enforce(router.session)
        now = {str(zid) for zid in router.session.info.routers_zid()}
        for zid in now - linked:
            log.info("linked with router %s", zid)
        for zid in linked - now:
            log.warning("the link with router %s is lost", zid)
        linked = now


def is_reached(endpoint: str, token: str, timeout: float, credentials: Credentials | None = None) -> bool:
    """Return whether a router answers at the endpoint within `timeout` [s] and, unless empty, has the token."""
    try:
        session = zenoh.open(client_config(endpoint, connect_ms=int(timeout * 1000), credentials=credentials))
    except zenoh.ZError:
        return False
    with session:
        return not token or any(reply.ok is not None for reply in session.liveliness().get(token, timeout=timeout))
