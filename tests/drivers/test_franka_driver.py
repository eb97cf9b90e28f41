"""The drivers of Franka's arm and hand with a fake library: the arm's clock, and reports of grasps."""

import math
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from common.config import load_cell
from common.hardware.driven_gripper import FingerState
from drivers import franka
from drivers.franka_hand import connect

MILLISECOND = 1e-3
GRIPPER = load_cell("panda").robot.gripper


def columns(z: float, yaw: float) -> list[float]:
    """Return a pose turned about z and moved along it as the arm reports it: columns first."""
    c, s = math.cos(yaw), math.sin(yaw)
    return [c, s, 0, 0, -s, c, 0, 0, 0, 0, 1, 0, 0, 0, z, 1]


class Clocks:
    """The clock of the host, and that of an arm at a share of its speed."""

    def __init__(self, driver: franka.FrankaArm) -> None:
        self.driver, self.host, self.arms, self.share = driver, 100.0, 7.0, 1.0
        self.exerted = [0.0] * 6

    def monotonic(self) -> float:
        return self.host

    def state(self) -> SimpleNamespace:
        rest = np.zeros(7)
        return SimpleNamespace(q=rest, dq=rest, q_d=rest, dq_d=rest, ddq_d=rest,
                               robot_mode=SimpleNamespace(name="Move"), m_load=0.3, F_x_Cload=[0.0, 0.0, 0.1],
                               K_F_ext_hat_K=self.exerted, F_T_EE=columns(0.1034, math.pi / 4),
                               EE_T_K=columns(0.05, 0.2), time=SimpleNamespace(to_sec=lambda: self.arms))

    def run(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the host's time and that of the due set-points, for each cycle of a period of the arm's time."""
        rows = []
        for _ in range(round(seconds / MILLISECOND)):
            self.arms += MILLISECOND
            self.host += MILLISECOND / self.share
            self.driver.read()
            (due,) = self.driver.due()
            self.driver.servo([np.zeros(7)])
            rows.append((self.host, due))
        host, due = np.array(rows).T
        assert np.all(np.diff(due) > 0) and np.all(due <= host + MILLISECOND), "no future set-points are requested"
        return host, due


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    def read_once() -> SimpleNamespace:
        return clocks.state()

    control = SimpleNamespace(writeOnce=lambda command: None, readOnce=lambda: (clocks.state(), 0.0))
    library = ModuleType("pylibfranka")
    library.__dict__.update(
        RealtimeConfig=SimpleNamespace(kIgnore=0), ControllerMode=SimpleNamespace(JointImpedance=0),
        JointPositions=lambda q: SimpleNamespace(q=q), ControlException=RuntimeError,
        Robot=lambda host, realtime: SimpleNamespace(
            read_once=read_once, start_joint_position_control=lambda mode: control))
    monkeypatch.setitem(sys.modules, "pylibfranka", library)
    clocks = Clocks(franka.FrankaArm(franka.Options(host="nowhere")))
    monkeypatch.setattr(franka.time, "monotonic", clocks.monotonic)
    return clocks


@pytest.mark.parametrize("share", [1.0, 0.95, 0.7, 0.35])
def test_set_points_are_current_at_any_speed_of_the_arms_clock(clocks: Clocks, share: float) -> None:
    clocks.share = share
    clocks.run(1.0)
    host, due = clocks.run(2.0)
    assert (host - due).max() < 0.02
    assert clocks.driver.read().speed == (1.0 if share == 1.0 else pytest.approx(share, abs=0.1))
    assert clocks.driver.read().speed <= share
    assert 1 / clocks.driver.rate == pytest.approx(np.diff(due)[-1], rel=0.02)


def test_changing_clock_is_followed(clocks: Clocks) -> None:
    clocks.share = 0.35
    clocks.run(2.0)
    for clocks.share in (0.8, 0.3, 0.6):
        host, due = clocks.run(2.0)
        assert (host - due)[-1] < 0.02 and (host - due).max() < 0.4, clocks.share


def test_clock_at_the_hosts_rate_is_followed_evenly(clocks: Clocks) -> None:
    clocks.share = 0.9999
    clocks.run(1.0)
    assert np.abs(np.diff(clocks.run(2.0)[1], 2)).max() < 1e-6
    assert clocks.driver.rate == pytest.approx(franka.RATE, rel=1e-2) and clocks.driver.read().speed == 1.0


class Gripper:
    """Fingers that close on an object; as in libfranka, a grasp succeeds within the tolerance of the width."""

    between = 0.0

    def __init__(self, host: str) -> None:
        self.width, self.grasped = 0.08, False

    def read_once(self) -> SimpleNamespace:
        return SimpleNamespace(width=self.width, max_width=0.08, is_grasped=self.grasped)

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> bool:
        self.width = self.between
        self.grasped = width - inner < self.width < width + outer
        return self.grasped

    def move(self, width: float, speed: float) -> bool:
        self.width, self.grasped = width, False
        return True


@pytest.mark.parametrize(("between", "holds"), [(0.0, False), (0.0004, False), (0.002, True), (0.06, True)])
def test_closed_fingers_hold_nothing(monkeypatch: pytest.MonkeyPatch, between: float, holds: bool) -> None:
    monkeypatch.setattr(Gripper, "between", between)
    library = SimpleNamespace(Gripper=Gripper, CommandException=RuntimeError)
    monkeypatch.setitem(sys.modules, "pylibfranka", library)
    hand = connect({"host": "h"}, GRIPPER)
    assert hand.read() == FingerState(0.08, False, False, 0.0)
    hand.move(0.0, 20.0)
    assert hand.read() == FingerState(between, False, holds, 20.0 if holds else 0.0)
    hand.move(0.08, 20.0)
    assert not hand.read().holding


def test_wrench_is_what_acts_on_the_flange_and_unknown_near_a_singularity(clocks: Clocks) -> None:
    assert clocks.driver.read().wrench is None
    clocks.exerted = [10.0, 0.0, 0.0, 0.0, 0.0, 1.0]  # the arm pushes along x of K, 0.1534 m beyond the flange
    state = clocks.driver.read()
    yaw = math.pi / 4 + 0.2
    x, y = -10 * math.cos(yaw), -10 * math.sin(yaw)
    assert state.wrench == pytest.approx([x, y, 0, -0.1534 * y, 0.1534 * x, -1.0])
    assert state.payload == (0.3, 0.0, 0.0, 0.1)
