"""A certificate has a limited number of sessions, so that its holder cannot keep the others out."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from common.transport.credentials import credentials_of
from common.transport.router import PER_CERTIFICATE, Router, maintain
from tests.domains import free_port
from tests.security.raw_client import TIMEOUT, RawClient

MORE = PER_CERTIFICATE + 8


@pytest.mark.parametrize("at", ["gate", "near"])
def test_newest_sessions_beyond_the_limit_are_ended_for_a_service_only(certificates: Path, at: str) -> None:
    gated, near = (f"tls/127.0.0.1:{free_port()}" for _ in range(2))
    with Router([gated], certificates, near=[near]) as router, ExitStack() as stack:
        stop = threading.Event()
        stack.callback(stop.set)

        def sessions(name: str) -> set[str]:
            return {link.dst for link in router.session.info.links() if link.auth_identifier == name}

        def connect(name: str) -> None:
            endpoint = near if at == "near" else gated
            stack.enter_context(RawClient(endpoint, credentials_of(name, certificates)))

        def until(holds: Callable[[], bool]) -> None:
            deadline = time.monotonic() + TIMEOUT
            while not holds() and time.monotonic() < deadline:
                stop.wait(0.02)
            assert holds()

        for _ in range(PER_CERTIFICATE):
            connect("panda.camera_simulator")
        until(lambda: len(sessions("panda.camera_simulator")) == PER_CERTIFICATE)
        oldest = sessions("panda.camera_simulator")
        checked = threading.Semaphore(0)
        threading.Thread(target=maintain, args=(router, stop, checked.release), daemon=True).start()
        assert checked.acquire(timeout=TIMEOUT) and checked.acquire(timeout=TIMEOUT)  # it knows them now
        for _ in range(MORE - PER_CERTIFICATE):
            connect("panda.camera_simulator")
        for _ in range(MORE):
            connect("operator")
        until(lambda: len(sessions("operator")) == MORE)
        operators = sessions("operator")
        newest: set[str] = set()  # these clients connect again, each time with another address
        until(lambda: bool(newest.update(sessions("panda.camera_simulator") - oldest) or newest))
        until(lambda: not newest & sessions("panda.camera_simulator"))
        assert oldest <= sessions("panda.camera_simulator") and sessions("operator") == operators
