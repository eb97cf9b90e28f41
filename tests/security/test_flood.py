"""Silent connections keep no client with a valid certificate out."""

import socket
import time
from pathlib import Path

from common.transport.credentials import credentials_of
from common.transport.router import Router
from tests.security.raw_client import RawClient
from tests.security.test_routers import free_port

SILENT = 150  # Zenoh without the gate accepts no client for 100 ms after each
WITHIN = 3.0  # [s]


def test_silent_connections_keep_no_valid_certificate_out(certificates: Path) -> None:
    port = free_port()
    with Router([f"tls/127.0.0.1:{port}"], certificates):

        def seconds_to_connect() -> float:
            began = time.monotonic()
            operator = credentials_of("operator", certificates)
            with RawClient(f"tls/127.0.0.1:{port}", operator, connect_ms=int(1000 * WITHIN)) as client:
                assert client.connected
            return time.monotonic() - began

        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(SILENT)]
        assert seconds_to_connect() < WITHIN, "while the silent ones are open"
        for each in silent:
            each.close()
        assert seconds_to_connect() < WITHIN, "after the silent ones have closed"
