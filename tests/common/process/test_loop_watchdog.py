"""A stuck event loop ends its process: the timer with a simulated clock, the exit with real processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from common.process.lifeline import PERIOD, STUCK_EXIT, StallTimer
from common.transport.endpoint import endpoint_of
from tests.harness import wait_router

TIMEOUT = 20.0
CELL = str(Path(__file__).with_name("toy_cell.yaml"))


def test_turning_loop_is_never_stuck() -> None:
    timer = StallTimer()
    for k in range(100):
        assert timer.still_for(k * PERIOD) <= PERIOD
        timer.turned()


def test_stall_ends_with_the_next_turn() -> None:
    timer = StallTimer()
    assert [timer.still_for(k * PERIOD) for k in range(9)][-1] == 8 * PERIOD
    timer.turned()
    assert timer.still_for(9 * PERIOD) == 0.0


def test_suspended_process_is_not_stuck() -> None:
    timer = StallTimer()
    timer.still_for(0.0)
    assert timer.still_for(3600.0) <= 2 * PERIOD


@pytest.fixture
async def toy(processes, domain: int):
    processes.start("services.router", "--domain", str(domain))
    await wait_router(endpoint_of(domain), TIMEOUT)

    def start(mode: str):
        return processes.start("tests.common.process.toy", "--cell", CELL, "--domain", str(domain),
                               "--set", f"services.toy.mode={mode}", "--set", "watchdogs.loop=1.5")

    return start


async def test_stuck_service_exits_and_logs_where_it_is_stuck(toy, processes, until) -> None:
    process = toy("stuck")
    await until(lambda: process.poll() is not None)
    assert process.poll() == STUCK_EXIT
    output = processes.output(process)
    assert "in hang" in output, "the stacks of all threads"
    [line] = [line for line in output.splitlines() if "has not turned" in line]
    assert line.startswith("CRITICAL toy: the event loop has not turned for")


@pytest.mark.slow
async def test_blocked_thread_next_to_the_loop_does_not_count(toy, processes) -> None:
    process = toy("native")
    await processes.said(process, "woke up")
    assert process.poll() is None
    assert "not turned" not in processes.output(process)
