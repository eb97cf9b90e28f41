"""The router of a domain: one process that every service of the host is a client of."""

from __future__ import annotations

import argparse
import logging
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import psutil
import zenoh

from common.errors import ConfigError, ZencellError
from common.security.credentials import ROUTER_NAME, credentials_of, read_access, secure_folder
from common.transport.endpoint import (
    DEFAULT_DOMAIN,
    DOMAIN_VARIABLE,
    LINK_VARIABLE,
    LISTEN_VARIABLE,
    endpoint_of,
    endpoints_of,
    is_encrypted,
    is_loopback,
    port_of,
    router_config,
)
from common.transport.lifeline import Lifeline, fail, leave
from common.transport.log import log_to_stderr
from common.transport.service import add_process_options

log = logging.getLogger("router")

OPEN = (
    "whoever reaches %s can read and command every cell behind it: `zencell secure init DIR`, then --secure DIR "
    "(docs/security.md)"
)
_CLOSE_SECONDS = 0.4
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
    try:
        found = [c.pid for c in psutil.net_connections("tcp")
                 if c.status == psutil.CONN_LISTEN and c.laddr and c.laddr.port == port and c.pid]
        if found:
            process = psutil.Process(found[0])
            return f"process {process.pid} ({' '.join(process.cmdline()) or process.name()})"
    except psutil.Error as error:
        log.debug("holder of port %d: %s", port, error)
    return "another process"


def open_router(endpoints: Sequence[str], secured: Path | None = None, links: Sequence[str] = ()) -> zenoh.Session:
    """A session that routes for everybody who connects to the endpoints, and listens nowhere else.

    Args:
        endpoints: where.
        secured: folder of certificates and rules; without one everybody may do everything.
        links: endpoints of routers of other hosts; it is no error when nobody is there yet.

    Raises:
        PortInUse: names the port, the domain and the process that holds it.
        ConfigError: the router can not listen there for another reason.
    """
    for option, given in (("--listen", endpoints), ("--link", links)):
        for each in given:
            if secured is not None and not is_encrypted(each):
                raise ConfigError(option, each, "is an open endpoint: with certificates it must be tls/HOST:PORT")
    try:
        if secured is None:
            return zenoh.open(router_config(endpoints, links=links))
        credentials = credentials_of(ROUTER_NAME, secured)
        return zenoh.open(router_config(endpoints, credentials, read_access(secured), links))
    except zenoh.ZError as error:
        text = str(error)
        endpoint = next((each for each in endpoints if each in text), endpoints[0])
        if "os error 98" in text or "in use" in text:
            raise PortInUse(endpoint, holder_of(int(endpoint.rpartition(":")[2]))) from None
        reason = text.split(" at /", maxsplit=1)[0]  # without the place in Zenoh's own source
        raise ConfigError("endpoint", endpoint, f"can not be listened at: {reason}") from None


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


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        fail(ConfigError(self.prog, message, "can not be used; --help lists the options"))


def main() -> NoReturn:
    """Be the router until SIGINT, SIGTERM or the end of the supervisor; exit 2 when it can not listen."""
    parser = _Parser(prog="router")
    parser.add_argument("--domain", help="0 to 232 (ZENCELL_DOMAIN, 42)")
    parser.add_argument("--listen", metavar="ENDPOINT", action="append", default=[],
                        help="instead of 127.0.0.1; repeatable (ZENCELL_LISTEN)")
    parser.add_argument("--link", metavar="ENDPOINT", action="append", default=[],
                        help="router of another host to be linked with; repeatable (ZENCELL_LINK)")
    add_process_options(parser)
    options = parser.parse_args()
    lifeline = Lifeline(gate=options.gate)
    stop = threading.Event()
    lifeline.start()
    lifeline.on_stop(stop.set)
    log_to_stderr("router", as_json=options.log_json)
    gate = threading.Event()
    lifeline.on_gate(gate.set)
    while not gate.wait(0.02):
        if stop.is_set():
            leave(0)
    try:
        domain = options.domain if options.domain is not None else os.environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN)
        endpoints = endpoints_of("--listen", options.listen, LISTEN_VARIABLE) or [endpoint_of(domain)]
        links = endpoints_of("--link", options.link, LINK_VARIABLE)
        secured = secure_folder()
        session = open_router(endpoints, secured, links)
    except ZencellError as error:
        fail(error)
    log.info("listening at %s", " and ".join(endpoints))
    for endpoint in endpoints:
        if secured is None and not is_loopback(endpoint):
            log.warning(OPEN, endpoint)
    for link in links:
        log.info("to be linked with the router at %s", link)
    tell_of_links(session, stop)
    log.info("stopped: %s", lifeline.reason)
    closing = threading.Thread(target=session.close, daemon=True)
    closing.start()
    closing.join(_CLOSE_SECONDS)
    leave(0)
