"""Connections that say nothing keep nobody out who holds a certificate."""

import socket
import time
from pathlib import Path

from common.transport.credentials import credentials_of
from common.transport.router import Router
from tests.security.holders import Holder
from tests.security.test_routers import free_port

SILENT = 150  # Zenoh itself accepts nobody for 100 ms after each
WITHIN = 3.0  # [s]


def test_silent_connections_keep_no_valid_certificate_out(certificates: Path) -> None:
    port = free_port()
    with Router([f"tls/127.0.0.1:{port}"], certificates):

        def lets_in() -> float:
            began = time.monotonic()
            holder = credentials_of("operator", certificates)
            with Holder(f"tls/127.0.0.1:{port}", holder, connect_ms=int(1000 * WITHIN)) as one:
                assert one.connected
            return time.monotonic() - began

        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(SILENT)]
        assert lets_in() < WITHIN, "while they are there"
        for each in silent:
            each.close()
        assert lets_in() < WITHIN, "after they went"
