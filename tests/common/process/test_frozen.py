"""The health check of a container kills a service that stays stopped (SIGSTOP)."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from common.process.health import end_if_frozen, stopped_service
from tests.harness import freeze

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, as in a container")
OWN = os.getpid()


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


def test_service_that_runs_or_resumes_in_time_is_not_killed_and_one_that_stays_stopped_is(
    service: subprocess.Popen[bytes]
) -> None:
    waited: list[float] = []

    def resume_at_the_third(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            service.send_signal(signal.SIGCONT)
            os.waitid(os.P_PID, service.pid, os.WCONTINUED | os.WNOWAIT)

    assert stopped_service(OWN) is None and not end_if_frozen(OWN)
    freeze(service)
    assert stopped_service(OWN) == service.pid
    assert stopped_service(parent=service.pid) is None, "that of another parent"
    assert not end_if_frozen(OWN, resume_at_the_third)
    assert len(waited) == 3 and service.poll() is None
    freeze(service)
    waited.clear()
    assert end_if_frozen(OWN, waited.append)
    assert service.wait(10) == -signal.SIGKILL
    assert sum(waited) == pytest.approx(3.0)


def test_stopped_program_that_is_no_service_is_not_killed() -> None:
    program = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        freeze(program)
        assert stopped_service(OWN) is None
    finally:
        program.kill()
        program.communicate()
