"""A certificate has a limited number of sessions, so that its holder cannot keep the others out."""

import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from common.transport.credentials import credentials_of
from common.transport.router import PER_CERTIFICATE, Router, maintain
from tests.domains import free_port
from tests.security.raw_client import RawClient

MORE = PER_CERTIFICATE + 8


@pytest.mark.parametrize("at", ["gate", "near"])
def test_newest_sessions_beyond_the_limit_are_ended_for_a_service_only(certificates: Path, at: str) -> None:
    gated, near = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    with Router([gated], certificates, near=[near]) as router, ExitStack() as stack:
        stop = threading.Event()
        stack.callback(stop.set)

        def sessions(name: str) -> int:
            return sum(link.auth_identifier == name for link in router.session.info.links())

        def connect(name: str) -> None:
            endpoint = near if at == "near" else gated
            stack.enter_context(RawClient(endpoint, credentials_of(name, certificates)))

        for _ in range(MORE):
            connect("panda.camera_simulator")
            connect("operator")
        assert sessions("panda.camera_simulator") == MORE
        threading.Thread(target=maintain, args=(router, stop), daemon=True).start()
        fewest = MORE
        for _ in range(300):
            fewest = min(fewest, sessions("panda.camera_simulator"))
            if fewest <= PER_CERTIFICATE:
                break
            stop.wait(0.05)
        assert fewest == PER_CERTIFICATE and sessions("operator") == MORE
