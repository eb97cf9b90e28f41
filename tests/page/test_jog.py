"""Jogging on the page: why the arm does not move any more while a button is held."""

from __future__ import annotations

from typing import Any

import pytest

from common.messages import MotionOwner, MotionStatus
from page import manual_control as jog
from page.manual_control import Jogger
from page.permissions import BY, Permissions

OURS, FREE = MotionOwner(owner=BY, kind="operator", jogging=True), MotionOwner()
BOBS = MotionOwner(owner="bob", kind="operator", asked=True)


class Arm:
    """Takes velocities, as far as its owner lets it."""

    def __init__(self) -> None:
        self.doors, self.owner, self.at, self.told = Permissions(), FREE, 0.0, list[str]()
        self.jogger = Jogger(self, lambda _: {"joints": {"a": 0.1}}, lambda: (MotionStatus(), self.owner), lambda: "")

    def jog(self, acknowledged: int, **velocities: Any) -> None:
        pass

    def word(self, owner: MotionOwner, press: int = 1) -> None:
        """A button is still held, and the motion is somebody's: the next of one each 0.2 s."""
        self.owner, self.at = owner, self.at + 0.2
        self.jogger.hold("page", "joint:a:+", press, self.told.append)


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Arm:
    arm = Arm()
    monkeypatch.setattr(jog, "monotonic", lambda: arm.at)
    return arm


@pytest.mark.parametrize(("before", "then", "why"), [
    (OURS, FREE, "press it again"), (FREE, FREE, "its controller does not take it"), (OURS, BOBS, "owned by bob"),
])
def test_why_the_arm_does_not_move_while_a_button_is_held(
    arm: Arm, before: MotionOwner, then: MotionOwner, why: str
) -> None:
    for owner in [FREE, *[before] * 4, *[then] * 4]:
        arm.word(owner)
    assert len(arm.told) == 1 and why in arm.told[0]


def test_next_press_begins_anew(arm: Arm) -> None:
    for owner in [FREE, *[OURS] * 4, *[FREE] * 4]:
        arm.word(owner)
    for owner in [FREE] * 7:
        arm.word(owner, press=2)
    assert len(arm.told) == 2 and "its controller does not take it" in arm.told[1]
