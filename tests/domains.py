"""Domains and ports for the cells of tests, which no other test process uses."""

from __future__ import annotations

import fcntl
import os
import random
import socket
import tempfile
from collections import deque
from contextlib import suppress
from pathlib import Path

from common.transport.endpoint import BASE_PORT

DOMAINS = range(60, 233)
PORTS = range(20_000, 30_000)  # below those that the system takes for outgoing connections
_given: deque[int] = deque(maxlen=len(DOMAINS))  # returned, the latest last
_locks: dict[int, int] = {}  # lock descriptors by domain


def free_domain() -> int:
    """Return a domain with a free port, locked against other test processes until this one ends.

    Workers of one test run use disjoint ranges; a suite and a benchmark, or two suites, share all.

    Raises:
        RuntimeError: no domain is free.
    """
    share = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    domains = DOMAINS[share :: int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))]
    recent = [*_given][-(len(domains) // 2):]  # perhaps without a listener yet
    choices = [number for number in domains if number not in recent]
    random.shuffle(choices)
    for number in choices:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            with suppress(OSError):
                probe.bind(("127.0.0.1", BASE_PORT + number))
                _take(number)
                _given.append(number)
                return number
    raise RuntimeError(f"no domain from {domains[0]} to {domains[-1]} is free")


def free_port() -> int:
    """Return a free port of 127.0.0.1, locked against other test processes until this one ends.

    Raises:
        RuntimeError: none is free.
    """
    for port in random.sample(PORTS, len(PORTS)):
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            if port not in _locks:
                _take(port)
                return port
    raise RuntimeError(f"no port from {PORTS[0]} to {PORTS[-1]} is free")


def _take(domain: int) -> None:
    """Lock a domain or port until this process ends; raise OSError if another process holds it."""
    if domain in _locks:
        return
    folder = Path(tempfile.gettempdir(), f"zencell-test-domains-{os.getuid()}")
    folder.mkdir(exist_ok=True)
    lock = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise
    _locks[domain] = lock
