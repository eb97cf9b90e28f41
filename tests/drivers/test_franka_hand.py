"""The hand of Franka with a fake library: its report of a grasp."""

import sys
from types import SimpleNamespace

import pytest

from common.config import load_cell
from common.hardware.driven_gripper import FingerState
from drivers.franka_hand import connect

CONFIG = load_cell("panda").robot.gripper


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
    hand = connect({"host": "h"}, CONFIG)
    assert hand.read() == FingerState(0.08, False, False, 0.0)
    hand.move(0.0, 20.0)
    assert hand.read() == FingerState(between, False, holds, 20.0 if holds else 0.0)
    hand.move(0.08, 20.0)
    assert not hand.read().holding
