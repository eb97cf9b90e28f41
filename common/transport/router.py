"""The router of a domain: the one session that every service of the host is a client of."""

from __future__ import annotations

import errno
import logging
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import zenoh

from common.errors import ConfigError, ZencellError
from common.transport.credentials import (
    ACCESS,
    AUTHORITY,
    ROUTER_NAME,
    Credentials,
    credentials_of,
    read_access,
    require_pair,
)
from common.transport.endpoint import address_of, client_config, is_encrypted, port_of, router_config
from common.transport.front import Front

log = logging.getLogger("router")

_LOOK_SECONDS = 0.5  # between looks at the links with other routers


class PortInUse(ZencellError):
    """Somebody else listens where the router should."""

    def __init__(self, endpoint: str, holder: str) -> None:
        port = int(endpoint.rpartition(":")[2])
        super().__init__(
            f"port {port} (domain {port - port_of(0)}) is in use by {holder}; stop it or choose another --domain"
        )
        self.port = port
        self.holder = holder


def holder_of(port: int) -> str:
    """Who listens on a TCP port of this host, as well as the system lets us know."""
    import psutil  # here: a health check has to start fast

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
    """A router as `open_router` opens it; a secured one stands behind a front, and can show new certificates.

    A `with` block.
    """

    def __init__(
        self, endpoints: Sequence[str], secured: Path | None = None, links: Sequence[str] = (),
        small: Sequence[str] = (), near: Sequence[str] = (),
    ) -> None:
        """Listen; a secured one also at one of the `near` endpoints, without a front: another after each renewal.

        Raises:
            PortInUse, ConfigError: as `open_router`.
        """
        self._front: Front | None = None
        self._secured, self._links, self._small = secured, links, small
        self._near = deque(near if secured is not None else ())
        self._besides = [*endpoints]
        if secured is not None:
            _require_encrypted(endpoints, links)
            shown = [endpoint for endpoint in endpoints if endpoint.startswith("tls/")]
            self._besides = [endpoint for endpoint in endpoints if endpoint not in shown]
            with _named():
                self._front = Front(shown)
        try:
            self._files = self._seen = self._files_now()
            self.session = self._open()
        except BaseException:
            if self._front is not None:
                self._front.close()
            raise

    def __enter__(self) -> Router:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Route no more."""
        self.session.close()  # type: ignore[no-untyped-call]
        if self._front is not None:
            self._front.close()

    def _open(self) -> zenoh.Session:
        if self._front is None:
            return open_router(self._besides, self._secured, self._links, self._small)
        host, port = "127.0.0.1", _free_port()
        behind = [f"tls/{host}:{port}", *self._besides]
        self._near.rotate(1)  # the one of before is still listened at
        try:
            session = open_router([*behind, *[*self._near][:1]], self._secured, self._links, self._small)
        except PortInUse:
            if not self._near:
                raise
            log.warning("%s is in use by %s: services of this host come in with all others", self._near[0],
                        holder_of(address_of(self._near[0])[1]))
            session = open_router(behind, self._secured, self._links, self._small)
        with _named():
            self._front.open(host, port)
        return session

    def _files_now(self) -> dict[str, bytes]:
        names = (f"{AUTHORITY}.pem", f"{ROUTER_NAME}.pem", f"{ROUTER_NAME}.key", ACCESS)
        return {name: (self._secured / name).read_bytes() for name in names} if self._secured is not None else {}

    def renew(self) -> bool:
        """Whether certificates or rules are others than before, and are in force from now on; everybody connects anew.

        To be called again and again: they count when they were the same at two calls.

        Raises:
            ConfigError: they cannot be used; those of before stay in force, and this is said once.
        """
        if self._front is None or self._besides:
            return False
        try:
            now = self._files_now()
        except OSError:
            return False  # are just being replaced
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


@contextmanager
def _named() -> Iterator[None]:
    """Say of an endpoint of the front that cannot be had who has it, or why."""
    try:
        yield
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise PortInUse(error.filename, holder_of(address_of(error.filename)[1])) from None
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
    endpoints: Sequence[str], secured: Path | None = None, links: Sequence[str] = (), small: Sequence[str] = ()
) -> zenoh.Session:
    """A session that routes for everybody who connects to the endpoints, and listens nowhere else.

    Args:
        endpoints: where.
        secured: folder of certificates and rules; without one everybody may do everything.
        links: endpoints of routers of other hosts; it is no error when nobody is there yet.
        small: more keys, without the cell, under which nothing large travels.

    Raises:
        PortInUse: names the port, the domain and the process that holds it.
        ConfigError: the router cannot listen there for another reason.
    """
    if secured is not None:
        _require_encrypted(endpoints, links)
    try:
        if secured is None:
            return zenoh.open(router_config(endpoints, links=links, small=small))
        credentials = credentials_of(ROUTER_NAME, secured)
        return zenoh.open(router_config(endpoints, credentials, read_access(secured), links, small))
    except zenoh.ZError as error:
        text = str(error)
        endpoint = next((each for each in endpoints if each in text), endpoints[0])
        if "os error 98" in text or "in use" in text:
            raise PortInUse(endpoint, holder_of(int(endpoint.rpartition(":")[2]))) from None
        reason = text.split(" at /", maxsplit=1)[0]  # without the place in Zenoh's own source
        raise ConfigError("endpoint", endpoint, f"cannot be listened at: {reason}") from None


def tend(router: Router, stop: threading.Event, look: Callable[[], None] = lambda: None) -> None:
    """Show new certificates, and log which routers of other hosts are reached and lost, until told to stop.

    Args:
        router: that is tended.
        stop: ends it.
        look: called now and then.
    """
    linked: set[str] = set()
    while not stop.wait(_LOOK_SECONDS):
        try:
            if router.renew():
                log.warning("certificates or rules are new: everybody connects anew, with their own that are new")
        except ZencellError as error:
            log.error("%s; those of before stay in force", error)
        look()
        now = {str(zid) for zid in router.session.info.routers_zid()}
        for zid in now - linked:
            log.info("linked with router %s", zid)
        for zid in linked - now:
            log.warning("the link with router %s is lost", zid)
        linked = now


def is_reached(endpoint: str, token: str, timeout: float, credentials: Credentials | None = None) -> bool:
    """Whether a router answers at the endpoint within a time-out [s] and, unless empty, has a liveliness token."""
    try:
        session = zenoh.open(client_config(endpoint, connect_ms=int(timeout * 1000), credentials=credentials))
    except zenoh.ZError:
        return False
    with session:
        return not token or any(reply.ok is not None for reply in session.liveliness().get(token, timeout=timeout))
