"""The router of a domain: one process that every service of the host is a client of."""

from __future__ import annotations

import argparse
import logging
import os
import threading
from pathlib import Path
from typing import NoReturn

import psutil
import zenoh

from common.errors import ConfigError, ZencellError
from common.security.credentials import ROUTER_NAME, credentials_of, read_access, secure_folder
from common.transport.endpoint import (
    DEFAULT_DOMAIN,
    DOMAIN_VARIABLE,
    LISTEN_VARIABLE,
    endpoint_of,
    is_loopback,
    port_of,
    router_config,
)
from common.transport.lifeline import Lifeline, fail, leave
from common.transport.log import log_to_stderr
from common.transport.service import add_process_options

log = logging.getLogger("router")

_CLOSE_SECONDS = 0.4


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


def open_router(endpoint: str, secured: Path | None = None) -> zenoh.Session:
    """A session that routes for everybody who connects to the endpoint, and listens nowhere else.

    Args:
        endpoint: where.
        secured: folder of certificates and rules; without one everybody may do everything.

    Raises:
        PortInUse: names the port, the domain and the process that holds it.
        ConfigError: the router can not listen there for another reason.
    """
    try:
        if secured is None:
            return zenoh.open(router_config(endpoint))
        return zenoh.open(router_config(endpoint, credentials_of(ROUTER_NAME, secured), read_access(secured)))
    except zenoh.ZError as error:
        text = str(error)
        if "os error 98" in text or "in use" in text:
            raise PortInUse(endpoint, holder_of(int(endpoint.rpartition(":")[2]))) from None
        reason = text.split(" at /", maxsplit=1)[0]  # without the place in Zenoh's own source
        raise ConfigError("endpoint", endpoint, f"can not be listened at: {reason}") from None


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        fail(ConfigError(self.prog, message, "can not be used; --help lists the options"))


def main() -> NoReturn:
    """Be the router until SIGINT, SIGTERM or the end of the supervisor; exit 2 when it can not listen."""
    parser = _Parser(prog="router")
    parser.add_argument("--domain", help="0 to 232 (ZENCELL_DOMAIN, 42)")
    parser.add_argument("--listen", metavar="ENDPOINT", help="instead of 127.0.0.1 (ZENCELL_LISTEN)")
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
        listen = options.listen or os.environ.get(LISTEN_VARIABLE)
        endpoint = endpoint_of(connect=listen) if listen else endpoint_of(domain)
        secured = secure_folder()
        session = open_router(endpoint, secured)
    except ZencellError as error:
        fail(error)
    log.info("listening at %s", endpoint)
    if secured is None and not is_loopback(endpoint):
        log.warning("whoever reaches %s can read and command every cell behind it: see docs/security.md", endpoint)
    stop.wait()
    log.info("stopped: %s", lifeline.reason)
    closing = threading.Thread(target=session.close, daemon=True)
    closing.start()
    closing.join(_CLOSE_SECONDS)
    leave(0)
