"""A stuck event loop ends its process, and the health check of a container kills a service that stays stopped."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from common.process.health import end_if_frozen, stopped_service
from common.process.lifeline import PERIOD, STUCK_EXIT, StallTimer
from tests.common.transport.conftest import Processes, until
from tests.harness import freeze

CELL = str(Path(__file__).with_name("toy_cell.yaml"))
OWN = os.getpid()
linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, as in a container")


def test_only_a_loop_that_does_not_turn_is_stuck_and_a_suspended_process_is_not() -> None:
    timer = StallTimer()
    for k in range(100):
        assert timer.still_for(k * PERIOD) <= PERIOD
        timer.turned()
    assert [timer.still_for((100 + k) * PERIOD) for k in range(9)][-1] == 8 * PERIOD
    timer.turned()
    assert timer.still_for(109 * PERIOD) == 0.0
    assert timer.still_for(109 * PERIOD + 3600.0) <= 2 * PERIOD


def start(processes: Processes, endpoint: str, mode: str):
    return processes.start("tests.common.process.toy", "--cell", CELL, "--connect", endpoint, "--set", f"cell={mode}",
                           "--set", f"services.toy.mode={mode}", "--set", "watchdogs.loop=1")


async def test_stuck_service_exits_and_logs_where_it_is_stuck(processes, shared_router) -> None:
    process = start(processes, shared_router, "stuck")
    await until(lambda: process.poll() is not None)
    assert process.poll() == STUCK_EXIT
    output = processes.output(process)
    assert "in hang" in output, "the stacks of all threads"
    [line] = [line for line in output.splitlines() if "has not turned" in line]
    assert line.startswith("CRITICAL toy: the event loop has not turned for")


@pytest.mark.slow
async def test_blocked_thread_next_to_the_loop_does_not_count(processes, shared_router) -> None:
    process = start(processes, shared_router, "native")
    await processes.printed(process, "woke up")
    assert process.poll() is None
    assert "not turned" not in processes.output(process)


@linux
def test_service_that_runs_or_resumes_in_time_is_not_killed_and_one_that_stays_stopped_is() -> None:
    service = subprocess.Popen([sys.executable, "-m", "http.server", "--bind", "127.0.0.1", "0"],
                               stdout=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    waited: list[float] = []

    def resume_at_the_third(seconds: float) -> None:
        waited.append(seconds)
        if len(waited) == 3:
            service.send_signal(signal.SIGCONT)
            os.waitid(os.P_PID, service.pid, os.WCONTINUED | os.WNOWAIT)

    with service, ExitStack() as stack:
        stack.callback(service.kill)
        service.stdout.readline()
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


@linux
def test_stopped_program_that_is_no_service_is_not_killed() -> None:
    program = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        freeze(program)
        assert stopped_service(OWN) is None
    finally:
        program.kill()
        program.communicate()
