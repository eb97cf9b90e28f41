"""The judgement with a clock of the test's own; that a stuck process really ends, with processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from common.process.lifeline import PERIOD, STUCK_EXIT, StallTimer
from common.transport.endpoint import endpoint_of
from tests.harness import wait_router

PATIENCE = 20.0
CELL = str(Path(__file__).with_name("toy_cell.yaml"))


def test_a_loop_that_turns_is_never_stuck() -> None:
    turning = StallTimer()
    for k in range(100):
        assert turning.still_for(k * PERIOD) <= PERIOD
        turning.turned()


def test_time_without_a_turn_adds_up_and_a_turn_ends_it() -> None:
    turning = StallTimer()
    assert [turning.still_for(k * PERIOD) for k in range(9)][-1] == 8 * PERIOD
    turning.turned()
    assert turning.still_for(9 * PERIOD) == 0.0


def test_a_process_that_was_suspended_as_a_whole_is_not_stuck() -> None:
    turning = StallTimer()
    turning.still_for(0.0)
    assert turning.still_for(3600.0) <= 2 * PERIOD


@pytest.fixture
async def toy(processes, domain: int):
    processes.start("services.router", "--domain", str(domain))
    await wait_router(endpoint_of(domain), PATIENCE)

    def start(mode: str):
        return processes.start("tests.common.process.toy", "--cell", CELL, "--domain", str(domain),
                               "--set", f"services.toy.mode={mode}", "--set", "watchdogs.loop=1.5")

    return start


async def test_a_stuck_service_ends_itself_and_says_where_it_hangs(toy, processes, until) -> None:
    process = toy("stuck")
    await until(lambda: process.poll() is not None)
    assert process.poll() == STUCK_EXIT
    output = processes.output(process)
    assert "in hang" in output, "the stacks of all threads"
    [line] = [line for line in output.splitlines() if "has not turned" in line]
    assert line.startswith("CRITICAL toy: the event loop has not turned for")


@pytest.mark.slow
async def test_what_blocks_a_thread_beside_the_loop_does_no_harm(toy, processes) -> None:
    process = toy("native")
    await processes.said(process, "woke up")
    assert process.poll() is None
    assert "not turned" not in processes.output(process)
