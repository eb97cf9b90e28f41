"""Silent processes are killed in time and no others, on a clock of the test; forged messages are no sign of life."""

import asyncio
from types import SimpleNamespace

import pytest

from common import topics
from common.config import Watchdogs, load_cell
from common.messages import ServiceCounters, ServiceStatus
from common.supervision.lifecycle import kill_frozen
from common.supervision.liveness_watchdog import LEASE, PERIOD, LivenessWatchdog
from common.transport.codec import encode
from common.transport.local import LocalNetwork
from tests.harness import running_with

SERVICES = ["camera", "detector", "task"]
LIMIT, START = Watchdogs().silence, Watchdogs().start


class Cell:
    """Services that send a sign of life each period, except the silent ones."""

    def __init__(self, *names: str, **limits: float) -> None:
        self.watchdog = LivenessWatchdog(Watchdogs(**limits))
        self.states = {name: ServiceStatus(name=name, state="ready", pid=k + 1)
                       for k, name in enumerate(names or ["router", *SERVICES])}
        self.silent: set[str] = set()
        self.stopped: list[str] = []
        self.starved: set[str] = set()
        self.waited = dict.fromkeys(self.states, 0.0)
        self.connected = True
        self.now = 100.0
        self.killed: list[tuple[str, str]] = []

    def wait(self, seconds: float, period: float = PERIOD) -> list[str]:
        """Return the names of killed processes; each is restarted at once and sends again."""
        before, end = len(self.killed), self.now + seconds
        while self.now < end:
            self.now += period
            for name in self.starved:
                self.waited[name] += 0.9 * period
            router_works = self.connected and "router" not in self.silent
            for name in set(self.states) - self.silent - {"router"}:
                if router_works and self.states[name].state == "ready":
                    self.watchdog.seen(name)
            states = list(self.states.values())
            for verdict in self.watchdog.check(self.now, self.connected, states, self.stopped, dict(self.waited)):
                self.killed.append((verdict.name, verdict.reason))
                self.restart(verdict.name, "ready")
                self.silent.discard(verdict.name)
        return [name for name, _ in self.killed[before:]]

    def restart(self, name: str, state: str) -> None:
        pid = self.states[name].pid
        assert pid is not None
        self.states[name] = self.states[name].model_copy(update={"pid": pid + 100, "state": state})

    def recovers(self) -> bool:
        """Return whether no process is killed once all send again."""
        self.silent, self.connected = set(), True
        return self.wait(60) == []


@pytest.fixture
def cell() -> Cell:
    made = Cell()
    assert made.recovers()
    return made


def test_silent_service_is_killed_in_time_and_no_other(cell: Cell) -> None:
    cell.silent = {"detector"}
    assert cell.wait(LIMIT - 0.5) == []
    assert cell.wait(1.0) == ["detector"]
    assert "has sent nothing for 7" in cell.killed[0][1]
    assert cell.wait(60) == []


def test_service_that_waits_for_a_processor_is_not_killed(cell: Cell) -> None:
    cell.silent = cell.starved = {"detector"}
    assert cell.wait(5 * LIMIT) == []
    assert cell.recovers()
    cell.silent, cell.starved = {"detector"}, set()
    assert cell.wait(LIMIT - 0.5) == []
    assert cell.wait(1.0) == ["detector"], "earlier waiting is no credit"


def test_service_that_never_sends_after_it_is_ready_is_killed() -> None:
    cell = Cell()
    cell.silent = {"task"}
    assert cell.wait(LIMIT + 1) == ["task"]


def test_only_the_router_is_blamed_while_it_is_not_reached(cell: Cell) -> None:
    cell.silent, cell.connected = {"router"}, False  # its loss was noticed
    assert cell.wait(LIMIT - LEASE - 0.5) == []
    assert cell.wait(1.0) == ["router"]
    assert "does not answer" in cell.killed[0][1]
    assert cell.recovers()


def test_restart_of_the_router_kills_no_service(cell: Cell) -> None:
    cell.connected = False
    cell.restart("router", "starting")
    assert cell.wait(20) == []
    cell.restart("router", "ready")
    cell.connected, cell.silent = True, {"detector"}  # it is not reconnected yet
    assert cell.wait(LIMIT - 1) == []
    assert cell.recovers()


def test_router_is_killed_if_all_services_are_silent_and_then_those_that_stay_silent(cell: Cell) -> None:
    cell.silent = {"router", *SERVICES}
    assert cell.wait(LIMIT + 1) == ["router"]
    assert cell.recovers()
    cell.silent = set(SERVICES)
    assert cell.wait(LIMIT + 1) == ["router"]
    assert set(cell.wait(LIMIT + 1)) == set(SERVICES)


def test_without_a_router_of_our_own_no_process_is_killed_if_all_are_silent() -> None:
    cell = Cell(*SERVICES)
    cell.wait(5)
    cell.silent = set(SERVICES)
    assert cell.wait(LIMIT + 1) == []


@pytest.mark.parametrize("stall", [5.0, 3600.0])
def test_time_in_which_the_supervisor_slept_does_not_count(cell: Cell, stall: float) -> None:
    cell.silent = {"detector"}
    cell.wait(LIMIT - 2)
    cell.now += stall
    assert cell.wait(PERIOD) == []
    assert cell.recovers()


def test_late_checks_on_a_slow_machine_count_little(cell: Cell) -> None:
    cell.silent = {"detector"}
    assert cell.wait(3 * LIMIT, period=2.0) == []


@pytest.mark.parametrize(("stopped", "limit"), [([], START), (["camera"], LIMIT)])
def test_starting_service_has_more_time_unless_it_is_stopped(stopped: list[str], limit: float) -> None:
    cell = Cell()
    cell.restart("camera", "starting")
    cell.stopped = stopped
    assert cell.wait(limit - 1) == []
    assert cell.wait(2) == ["camera"]
    assert "is not ready" in cell.killed[0][1]


def test_limit_of_zero_disables_the_watchdog() -> None:
    cell = Cell(silence=0)
    cell.silent, cell.connected = {"router", *SERVICES}, False
    assert cell.wait(600) == []


async def test_counters_under_the_key_of_another_service_are_no_sign_of_life() -> None:
    spacing = 0.02  # [s]
    net, cell = LocalNetwork(), load_cell("panda", ["watchdogs.silence=0.5"])
    killed: asyncio.Queue[str] = asyncio.Queue()
    names = ("camera_simulator", "vision_detector")
    supervisor = SimpleNamespace(
        restartable=[ServiceStatus(name=name, state="ready", pid=number) for number, name in enumerate(names, 1)],
        stopped=(), waited={}, kill=lambda name, reason: killed.put_nowait(name),
    )
    bus, camera = (net.bus(name, cell=cell.name) for name in ("supervisor", "camera_simulator"))
    own = camera.raw_publisher(f"{cell.name}/counters/camera_simulator", "", reliable=True)

    async def forge() -> None:
        while True:
            for name in names:
                own.put(encode(ServiceCounters(service=name)), b"")
                await asyncio.sleep(spacing)

    async with running_with(kill_frozen(bus, cell, supervisor, spacing), forge()), asyncio.timeout(20):
        assert await killed.get() == "vision_detector"
    assert bus.counters().invalid[topics.COUNTERS.key] > 0
