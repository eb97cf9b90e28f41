"""The router of a domain, as a process: `python -m services.router --domain 42`."""

from __future__ import annotations

import argparse
import os
import resource
import threading
from typing import NoReturn

from common.errors import ConfigError, ZencellError
from common.process.environment import use_single_memory_arena
from common.process.lifeline import Lifeline, exit_now, exit_with_error
from common.process.log import log_to_stderr
from common.process.service import add_process_options
from common.transport.credentials import CertificateMonitor, secure_folder
from common.transport.endpoint import (
    DEFAULT_DOMAIN,
    DOMAIN_VARIABLE,
    LINK_VARIABLE,
    LISTEN_VARIABLE,
    endpoint_of,
    endpoints_of,
    is_loopback,
)
from common.transport.router import Router, log, maintain

OPEN = (
    "whoever reaches %s can read and command every cell behind it: `zencell secure init DIR`, then --secure DIR "
    "(docs/security.md)"
)
_CLOSE_SECONDS = 0.4
_READERS = 16  # threads that take what comes: each may wait for somebody who falls behind in pictures


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        exit_with_error(ConfigError(self.prog, message, "cannot be used; --help lists the options"))


def _read_beside() -> None:
    """Have more threads than Zenoh's two read what comes, before it is used for the first time.

    With two, nobody hears anything while two writers of pictures wait for a reader that falls behind.
    """
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {_READERS}))")


def main() -> NoReturn:
    """Be the router until SIGINT, SIGTERM or the end of the supervisor; exit 2 when it cannot listen."""
    parser = _Parser(prog="router")
    parser.add_argument("--domain", help="0 to 232 (ZENCELL_DOMAIN, 42)")
    parser.add_argument("--listen", metavar="ENDPOINT", action="append", default=[],
                        help="instead of 127.0.0.1; repeatable (ZENCELL_LISTEN)")
    parser.add_argument("--link", metavar="ENDPOINT", action="append", default=[],
                        help="router of another host to be linked with; repeatable (ZENCELL_LINK)")
    parser.add_argument("--near", metavar="ENDPOINT", action="append", default=[],
                        help="with certificates: where to listen besides, for services of this host, who need no "
                             "front there; repeatable, taken by turns with each renewal")
    parser.add_argument("--small", metavar="KEY", action="append", default=[],
                        help="without the cell: drop what is too large for it, as on the keys of small messages that "
                             "are known; repeatable")
    add_process_options(parser)
    options = parser.parse_args()
    use_single_memory_arena()
    _read_beside()
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # a connection takes three files in a secured router
    lifeline = Lifeline(gate=options.gate)
    stop = threading.Event()
    lifeline.start()
    lifeline.on_stop(stop.set)
    log_to_stderr("router", as_json=options.log_json)
    gate = threading.Event()
    lifeline.on_gate(gate.set)
    while not gate.wait(0.02):
        if stop.is_set():
            exit_now(0)
    try:
        domain = options.domain if options.domain is not None else os.environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN)
        endpoints = endpoints_of("--listen", options.listen, LISTEN_VARIABLE) or [endpoint_of(domain)]
        links = endpoints_of("--link", options.link, LINK_VARIABLE)
        secured = secure_folder()
        router = Router(endpoints, secured, links, options.small, options.near)
    except ZencellError as error:
        exit_with_error(error)
    log.info("listening at %s", " and ".join(endpoints))
    for endpoint in endpoints:
        if secured is None and not is_loopback(endpoint):
            log.warning(OPEN, endpoint)
    for link in links:
        log.info("to be linked with the router at %s", link)
    ends = CertificateMonitor()
    maintain(router, stop, lambda: ends.log_new(log))
    log.info("stopped: %s", lifeline.reason)
    closing = threading.Thread(target=router.close, daemon=True)
    closing.start()
    closing.join(_CLOSE_SECONDS)
    exit_now(0)


if __name__ == "__main__":
    main()
