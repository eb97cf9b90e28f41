"""One time for all processes of a host, also when its system clock steps or the host sleeps; time while awake."""

import pytest

from common import clock as clocks
from common.clock import BOOTED_VARIABLE, CLOCK_FOLDER_VARIABLE, Clock
from common.time_source import WatchdogClock, use_time_source

HOUR = 3600 * 10**9


class Host:
    """A host with simulated clocks."""

    def __init__(self):
        self.own, self.wall, self.asleep = 5 * HOUR, 1_700_000_000 * 10**9, 0

    def pass_time(self, ns):
        self.own, self.wall = self.own + ns, self.wall + ns

    def host_ns(self):
        return self.own

    def monotonic_ns(self):
        return self.own - self.asleep

    def wall_ns(self):
        return self.wall

    def token_hex(self, count):
        return "00" * count


@pytest.fixture
def host():
    source = Host()
    with use_time_source(source):
        yield source


@pytest.mark.parametrize(("speed", "step"), [(1.0, HOUR), (1.0, -HOUR), (3.0, -HOUR), (3.0, 600 * 10**9)])
def test_process_restarted_after_a_step_of_the_system_clock_agrees_with_the_others(host, speed, step):
    supervisor = Clock(speed)
    variables = supervisor.environment()
    first = Clock.from_environment(variables)
    host.pass_time(10**9)
    host.wall += step
    host.pass_time(10**9)
    again = Clock.from_environment(variables)
    assert again.now_ns() == first.now_ns() == supervisor.now_ns() == supervisor.epoch_ns + int(2e9 * speed)


def test_process_that_loses_its_processor_while_it_reads_the_clocks_agrees_with_the_others(host, monkeypatch):
    first, losses = Clock(), iter([4_000_000, 4_000_000, 0, 0])

    def lose_processor():
        wall = host.wall
        host.pass_time(next(losses))
        return wall

    monkeypatch.setattr(host, "wall_ns", lose_processor)
    second = Clock(epoch_ns=first.epoch_ns)
    assert second.now_ns() == first.now_ns()


def test_processes_started_before_and_after_a_sleep_of_the_host_agree(host):
    supervisor = Clock()
    host.pass_time(HOUR)
    host.asleep += HOUR
    assert supervisor.now_ns() == host.wall_ns() == Clock.from_environment(supervisor.environment()).now_ns()
    assert Clock().now_ns() == supervisor.now_ns(), "also without a supervisor"


def test_processes_without_a_supervisor_agree_by_a_shared_folder_until_the_host_reboots(host, tmp_path, monkeypatch):
    boot_id = tmp_path / "boot_id"
    boot_id.write_text("a\n")
    monkeypatch.setattr(clocks, "BOOT_ID", boot_id)
    shared = {CLOCK_FOLDER_VARIABLE: str(tmp_path)}
    first = Clock.from_environment(shared)
    host.wall += HOUR
    assert Clock.from_environment(shared).now_ns() == first.now_ns()
    assert Clock.from_environment({}).now_ns() == first.now_ns() + HOUR
    boot_id.write_text("b\n")
    assert Clock.from_environment(shared).now_ns() == first.now_ns() + HOUR
    assert sorted(path.name for path in tmp_path.iterdir()) == ["boot_id", "clock-a", "clock-b"]


def test_variable_takes_precedence_over_the_folder_and_invalid_ones_are_refused(host, tmp_path):
    both = {BOOTED_VARIABLE: "17", CLOCK_FOLDER_VARIABLE: str(tmp_path)}
    assert Clock.from_environment(both).booted_ns == 17 and not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="invalid literal"):
        Clock.from_environment({BOOTED_VARIABLE: "yesterday"})
    with pytest.raises(ValueError, match=r"ZENCELL_CLOCK .*/none: No such file"):
        Clock.from_environment({CLOCK_FOLDER_VARIABLE: str(tmp_path / "none")})


def test_watchdog_clock_limits_a_gap_to_one_period_and_ignores_a_step_back() -> None:
    clock = WatchdogClock(0.5)
    assert [round(clock.advance(now), 6) for now in (10.0, 10.25, 10.5, 10.9)] == [0.0, 0.25, 0.5, 0.9]
    assert clock.late == 0.0
    assert round(clock.advance(70.0), 6) == 1.4
    assert round(clock.late, 6) == 58.6
    assert round(clock.advance(70.25), 6) == 1.65
    assert clock.late == 0.0
    assert round(clock.advance(60.0), 6) == 1.65
