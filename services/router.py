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

OPEN_WARNING = (
    "every client that reaches %s can read and command every cell of this router: `zencell secure init DIR`, then "
    "--secure DIR (docs/security.md)"
)
_CLOSE_SECONDS = 0.4
_RECEIVE_THREADS = 16  # each may wait for a reader that takes its images too slowly


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        exit_with_error(ConfigError(self.prog, message, "cannot be used; --help lists the options"))


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="router")
    parser.add_argument("--domain", help="0 to 232 (ZENCELL_DOMAIN, 42)")
    parser.add_argument("--listen", metavar="ENDPOINT", action="append", default=[],
                        help="instead of 127.0.0.1; repeatable (ZENCELL_LISTEN)")
    parser.add_argument("--link", metavar="ENDPOINT", action="append", default=[],
                        help="router of another host to link with; repeatable (ZENCELL_LINK)")
    parser.add_argument("--near", metavar="ENDPOINT", action="append", default=[],
                        help="with certificates: additional listener for services of this host, which bypass the TLS "
                             "gate there; repeatable, each renewal switches to the next one")
    parser.add_argument("--small", metavar="KEY", action="append", default=[],
                        help="key, without the cell, of a remapped topic of small messages: the router drops larger "
                             "ones, as on the standard keys; repeatable")
    add_process_options(parser)
    return parser


def _prepare_process() -> None:
    """Set the limits of this process; must run before the first use of Zenoh."""
    use_single_memory_arena()
    # With Zenoh's two threads no client receives anything while two writers of images wait for a slow reader.
    os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {_RECEIVE_THREADS}))")
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # a connection needs three files in a secured router


def _wait_for_gate(lifeline: Lifeline, stop: threading.Event) -> None:
    """Return when the supervisor lets the router start; exit when it is stopped before."""
    gate = threading.Event()
    lifeline.on_gate(gate.set)
    while not gate.wait(0.02):
        if stop.is_set():
            exit_now(0)


def _open_router(options: argparse.Namespace) -> Router:
    """Return the router that listens as the options say; exit 2 when it cannot."""
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
            log.warning(OPEN_WARNING, endpoint)
    for link in links:
        log.info("linking with the router at %s", link)
    return router


def main() -> NoReturn:
    """Run the router until SIGINT, SIGTERM or the end of the supervisor; exit 2 when it cannot listen."""
    options = _parser().parse_args()
    _prepare_process()
    lifeline = Lifeline(gate=options.gate)
    stop = threading.Event()
    lifeline.start()
    lifeline.on_stop(stop.set)
    log_to_stderr("router", as_json=options.log_json)
    _wait_for_gate(lifeline, stop)
    router = _open_router(options)
    certificates = CertificateMonitor()
    maintain(router, stop, lambda: certificates.log_new(log))
    log.info("stopped: %s", lifeline.reason)
    closing = threading.Thread(target=router.close, daemon=True)
    closing.start()
    closing.join(_CLOSE_SECONDS)
    exit_now(0)


if __name__ == "__main__":
    main()
