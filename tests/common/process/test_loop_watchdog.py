"""A stuck event loop ends its process: the timer with a simulated clock, the exit with real processes."""

from pathlib import Path

import pytest

from common.process.lifeline import PERIOD, STUCK_EXIT, StallTimer
from tests.common.transport.conftest import Processes, until

CELL = str(Path(__file__).with_name("toy_cell.yaml"))


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


async def test_stuck_service_exits_and_logs_where_it_is_stuck(processes: Processes, shared_router: str) -> None:
    process = start(processes, shared_router, "stuck")
    await until(lambda: process.poll() is not None)
    assert process.poll() == STUCK_EXIT
    output = processes.output(process)
    assert "in hang" in output, "the stacks of all threads"
    [line] = [line for line in output.splitlines() if "has not turned" in line]
    assert line.startswith("CRITICAL toy: the event loop has not turned for")


@pytest.mark.slow
async def test_blocked_thread_next_to_the_loop_does_not_count(processes: Processes, shared_router: str) -> None:
    process = start(processes, shared_router, "native")
    await processes.printed(process, "woke up")
    assert process.poll() is None
    assert "not turned" not in processes.output(process)
