from common.time_source import WatchdogClock


def test_time_between_looks_counts() -> None:
    awake = WatchdogClock(0.5)
    assert [round(awake.advance(now), 6) for now in (10.0, 10.25, 10.5, 10.9)] == [0.0, 0.25, 0.5, 0.9]
    assert awake.late == 0.0


def test_a_long_sleep_counts_as_one_period_and_is_told() -> None:
    awake = WatchdogClock(0.5)
    awake.advance(10.0)
    assert awake.advance(70.0) == 0.5
    assert awake.late == 59.5
    awake.advance(70.25)
    assert awake.late == 0.0


def test_a_clock_that_goes_back_counts_nothing() -> None:
    awake = WatchdogClock(0.5)
    awake.advance(10.0)
    assert awake.advance(9.0) == 0.0
