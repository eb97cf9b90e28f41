"""Who is killed for being silent, with a clock of the test's own."""

from __future__ import annotations

import pytest

from common.config import Watchdogs
from common.messages import ServiceStatus
from common.supervision.liveness_watchdog import LEASE, PERIOD, LivenessWatchdog

NAMES = ["router", "camera", "detector", "task"]
LIMIT, START = Watchdogs().silence, Watchdogs().start


class Cell:
    """Services that speak each second unless they are said to be silent."""

    def __init__(self, *names: str, **limits: float) -> None:
        self.silence = LivenessWatchdog(Watchdogs(**limits))
        self.states = {name: ServiceStatus(name=name, state="ready", pid=k + 1)
                       for k, name in enumerate(names or NAMES)}
        self.silent: set[str] = set()
        self.stopped: list[str] = []
        self.starved: set[str] = set()
        self.waited = dict.fromkeys(self.states, 0.0)
        self.connected = True
        self.now = 100.0
        self.killed: list[tuple[str, str]] = []

    def wait(self, seconds: float, period: float = PERIOD) -> list[str]:
        """Names of those that were killed meanwhile; a killed one is there again at once, and speaks."""
        before, end = len(self.killed), self.now + seconds
        while self.now < end:
            self.now += period
            for name in self.starved:
                self.waited[name] += 0.9 * period
            speaks = self.connected and "router" not in self.silent
            for name in set(self.states) - self.silent - {"router"}:
                if speaks and self.states[name].state == "ready":
                    self.silence.heard(name)
            states = list(self.states.values())
            for verdict in self.silence.look(self.now, self.connected, states, self.stopped, dict(self.waited)):
                self.killed.append((verdict.name, verdict.reason))
                self.restart(verdict.name, "ready")
                self.silent.discard(verdict.name)
        return [name for name, _ in self.killed[before:]]

    def restart(self, name: str, state: str) -> None:
        pid = self.states[name].pid
        assert pid is not None
        self.states[name] = self.states[name].model_copy(update={"pid": pid + 100, "state": state})


def test_nobody_is_killed_while_all_speak() -> None:
    assert Cell().wait(60) == []


def test_a_service_that_falls_silent_is_killed_in_time_and_no_other() -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent = {"detector"}
    assert cell.wait(LIMIT - 0.5) == []
    assert cell.wait(1.0) == ["detector"]
    assert "has not been heard for 7" in cell.killed[0][1]
    assert cell.wait(60) == []


def test_a_service_that_waits_for_a_processor_is_silent_and_not_killed_for_that() -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent = cell.starved = {"detector"}
    assert cell.wait(5 * LIMIT) == []
    cell.silent = set()
    assert cell.wait(5) == []
    cell.silent, cell.starved = {"detector"}, set()
    assert cell.wait(LIMIT - 0.5) == []
    assert cell.wait(1.0) == ["detector"], "what it waited before is no credit"


def test_a_service_that_never_speaks_once_it_is_ready_is_killed_too() -> None:
    cell = Cell()
    cell.silent = {"task"}
    assert cell.wait(LIMIT + 1) == ["task"]


def test_nobody_but_the_router_is_blamed_while_it_is_not_reached() -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent, cell.connected = {"router"}, False  # found to be lost
    assert cell.wait(LIMIT - LEASE - 0.5) == []
    assert cell.wait(1.0) == ["router"]
    assert "does not answer" in cell.killed[0][1]
    cell.connected = True
    assert cell.wait(60) == []


def test_a_router_that_died_and_comes_back_costs_nobody_else_its_life() -> None:
    cell = Cell()
    cell.wait(5)
    cell.connected = False
    cell.restart("router", "starting")
    assert cell.wait(20) == []
    cell.restart("router", "ready")
    cell.connected = True
    cell.silent = {"detector"}  # its connection is not back yet
    assert cell.wait(LIMIT - 1) == []
    cell.silent = set()
    assert cell.wait(60) == []


def test_a_router_that_lets_nobody_be_heard_is_killed_instead_of_everybody() -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent = set(NAMES)
    assert cell.wait(LIMIT + 1) == ["router"]
    cell.silent = set()
    assert cell.wait(60) == []


def test_services_that_stay_silent_with_another_router_are_killed() -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent = {"camera", "detector", "task"}
    assert cell.wait(LIMIT + 1) == ["router"]
    assert set(cell.wait(LIMIT + 1)) == {"camera", "detector", "task"}


def test_without_a_router_of_our_own_nobody_is_blamed_when_all_fall_silent() -> None:
    cell = Cell("camera", "detector", "task")
    cell.wait(5)
    cell.silent = {"camera", "detector", "task"}
    assert cell.wait(LIMIT + 1) == []


@pytest.mark.parametrize("stall", [5.0, 60.0, 3600.0])
def test_nobody_is_killed_for_what_we_have_slept_through(stall: float) -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent = {"detector"}
    cell.wait(LIMIT - 2)
    cell.now += stall
    assert cell.wait(PERIOD) == []
    cell.silent = set()
    assert cell.wait(60) == []


def test_looks_that_come_late_count_little() -> None:
    cell = Cell()
    cell.wait(5)
    cell.silent = {"detector"}
    assert cell.wait(3 * LIMIT, period=2.0) == [], "a machine on which everything takes long"


def test_a_service_that_starts_has_more_time() -> None:
    cell = Cell()
    cell.restart("camera", "starting")
    assert cell.wait(START - 1) == []
    assert cell.wait(2) == ["camera"]
    assert "is not ready" in cell.killed[0][1]


def test_a_service_that_is_stopped_while_it_starts_has_not() -> None:
    cell = Cell()
    cell.restart("camera", "starting")
    cell.stopped = ["camera"]
    assert cell.wait(LIMIT + 1) == ["camera"]


def test_with_a_limit_of_0_nobody_is_killed() -> None:
    cell = Cell(silence=0)
    cell.silent, cell.connected = set(NAMES), False
    assert cell.wait(600) == []
