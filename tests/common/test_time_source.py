from common.time_source import WatchdogClock


def test_watchdog_clock_limits_a_gap_to_one_period_and_ignores_a_step_back() -> None:
    clock = WatchdogClock(0.5)
    assert [round(clock.advance(now), 6) for now in (10.0, 10.25, 10.5, 10.9)] == [0.0, 0.25, 0.5, 0.9]
    assert clock.late == 0.0
    assert round(clock.advance(70.0), 6) == 1.4
    assert round(clock.late, 6) == 58.6
    assert round(clock.advance(70.25), 6) == 1.65
    assert clock.late == 0.0
    assert round(clock.advance(60.0), 6) == 1.65
