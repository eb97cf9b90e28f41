"""How the driver of a Franka follows the arm's clock, with a fake library."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from drivers import franka

MILLISECOND = 1e-3


class Clocks:
    """The clock of the host, and that of an arm at a share of its speed."""

    def __init__(self, driver: franka.FrankaArm) -> None:
        self.driver, self.host, self.arms, self.share = driver, 100.0, 7.0, 1.0

    def monotonic(self) -> float:
        return self.host

    def state(self) -> SimpleNamespace:
        rest = np.zeros(7)
        return SimpleNamespace(q=rest, dq=rest, q_d=rest, dq_d=rest, ddq_d=rest, time=self,
                               robot_mode=SimpleNamespace(name="Move"))

    def to_sec(self) -> float:
        return self.arms

    def run(self, seconds: float) -> list[tuple[float, float]]:
        """Return the host's time and the time of the due set-points, for each cycle of a period of the arm's time."""
        rows = []
        for _ in range(round(seconds / MILLISECOND)):
            self.arms += MILLISECOND
            self.host += MILLISECOND / self.share
            self.driver.read()
            (due,) = self.driver.due()
            self.driver.servo([np.zeros(7)])
            rows.append((self.host, due))
        return rows


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    def read_once() -> SimpleNamespace:
        return clocks.state()

    library, control = ModuleType("pylibfranka"), SimpleNamespace(writeOnce=lambda command: None)
    library.__dict__.update(
        RealtimeConfig=SimpleNamespace(kIgnore=0), ControllerMode=SimpleNamespace(JointImpedance=0),
        JointPositions=lambda q: SimpleNamespace(q=q), ControlException=RuntimeError,
        Robot=lambda host, realtime: SimpleNamespace(
            read_once=read_once, start_joint_position_control=lambda mode: control))
    monkeypatch.setitem(sys.modules, "pylibfranka", library)
    clocks = Clocks(franka.FrankaArm(franka.Options(host="nowhere")))
    control.readOnce = lambda: (clocks.state(), 0.0)
    monkeypatch.setattr(franka.time, "monotonic", clocks.monotonic)
    return clocks


@pytest.mark.parametrize("share", [1.0, 0.95, 0.7, 0.35])
def test_set_points_are_current_at_any_speed_of_the_arms_clock(clocks: Clocks, share: float) -> None:
    clocks.share = share
    clocks.run(1.0)
    host, due = np.array(clocks.run(2.0)).T
    assert np.all(np.diff(due) > 0) and np.all(due <= host + MILLISECOND)
    assert (host - due).max() < 0.02
    assert clocks.driver.read().speed == (1.0 if share == 1.0 else pytest.approx(share, abs=0.1))
    assert clocks.driver.read().speed <= share
    assert 1 / clocks.driver.rate == pytest.approx(np.diff(due)[-1], rel=0.02)


def test_changing_clock_is_followed_without_requesting_future_set_points(clocks: Clocks) -> None:
    clocks.share = 0.35
    clocks.run(2.0)
    for share in (0.8, 0.3, 0.6):
        clocks.share = share
        host, due = np.array(clocks.run(2.0)).T
        assert np.all(np.diff(due) > 0) and np.all(due <= host + MILLISECOND)
        assert (host - due)[-1] < 0.02, share
        assert (host - due).max() < 0.4, share


def test_clock_at_the_hosts_rate_is_followed_evenly(clocks: Clocks) -> None:
    clocks.share = 0.9999
    clocks.run(1.0)
    due = np.array(clocks.run(2.0))[:, 1]
    assert np.abs(np.diff(due, 2)).max() < 1e-6
    assert clocks.driver.rate == pytest.approx(franka.RATE, rel=1e-2) and clocks.driver.read().speed == 1.0
