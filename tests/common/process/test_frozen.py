"""The health check of a container kills a service that stays stopped (SIGSTOP)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from common.process.health import end_if_frozen, stopped_service
from tests.harness import freeze

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, as in a container")


@pytest.fixture
def service() -> Iterator[subprocess.Popen[bytes]]:
    """A running child process with a module name, like a service."""
    started = subprocess.Popen([sys.executable, "-m", "http.server", "--bind", "127.0.0.1", "0"],
                               stdout=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    assert started.stdout is not None
    started.stdout.readline()
    yield started
    started.kill()
    started.wait()
    started.stdout.close()


def test_running_service_is_not_killed(service: subprocess.Popen[bytes]) -> None:
    assert stopped_service(os.getpid()) is None
    assert not end_if_frozen(os.getpid())
    assert service.poll() is None


def test_stopped_service_is_killed(service: subprocess.Popen[bytes]) -> None:
    freeze(service)
    waited: list[float] = []
    assert end_if_frozen(os.getpid(), waited.append)
    assert service.wait(10) == -signal.SIGKILL
    assert sum(waited) == pytest.approx(3.0)


def test_service_that_resumes_in_time_is_not_killed(service: subprocess.Popen[bytes]) -> None:
    freeze(service)
    waited: list[float] = []

    def wait(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            service.send_signal(signal.SIGCONT)
            os.waitid(os.P_PID, service.pid, os.WCONTINUED | os.WNOWAIT)

    assert not end_if_frozen(os.getpid(), wait)
    assert len(waited) == 3
    assert service.poll() is None


def test_stopped_process_of_another_parent_is_not_killed(service: subprocess.Popen[bytes]) -> None:
    freeze(service)
    assert stopped_service(parent=service.pid) is None
    assert stopped_service(os.getpid()) == service.pid


def test_stopped_program_that_is_no_service_is_not_killed() -> None:
    program = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        freeze(program)
        assert stopped_service(os.getpid()) is None
    finally:
        program.kill()
        program.communicate()
