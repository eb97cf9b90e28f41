"""The router of a domain: the one session that every service of the host is a client of."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path

import zenoh

from common.errors import ConfigError, ZencellError
from common.transport.credentials import ROUTER_NAME, Credentials, credentials_of, read_access
from common.transport.endpoint import client_config, is_encrypted, port_of, router_config

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
    for option, given in (("--listen", endpoints), ("--link", links)):
        for each in given:
            if secured is not None and not is_encrypted(each):
                raise ConfigError(option, each, "is an open endpoint: with certificates it must be tls/HOST:PORT")
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


def tell_of_links(session: zenoh.Session, stop: threading.Event) -> None:
    """Log which routers of other hosts are reached and lost, until told to stop."""
    linked: set[str] = set()
    while not stop.wait(_LOOK_SECONDS):
        now = {str(zid) for zid in session.info.routers_zid()}
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
