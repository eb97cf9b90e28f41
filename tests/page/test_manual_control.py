"""Jogging: why a held button has no effect, one page at a time, and the names of the buttons."""

import re
from collections.abc import Iterator
from typing import Any

import pytest
import viser

from common.control.jogging import ENDED
from common.messages import MotionOwner, MotionStatus
from common.time_source import use_time_source
from page.access import PAGE, Permissions
from page.console import ActionQueue
from page.manual_control import Jogger, JogPanel
from tests.page.test_permissions import Clock

OURS, FREE = MotionOwner(owner=PAGE, kind="operator", jogging=True), MotionOwner()
BOBS = MotionOwner(owner="bob", kind="operator", asked=True)


class Arm:
    """Accepts jog commands; the test sets the motion owner."""

    def __init__(self, clock: Clock) -> None:
        self.permissions, self.owner, self.clock, self.rejected = Permissions(), FREE, clock, list[str]()
        self.jogs, self.motion = 0, MotionStatus()
        self.jogger = Jogger(self, lambda _: {"joints": {"a": 0.1}}, lambda: (self.motion, self.owner), lambda: "")

    def jog(self, acknowledged: int, **velocities: Any) -> None:
        self.jogs += bool(velocities)

    def hold(self, *owners: MotionOwner, press: int = 1, page: str = "one") -> None:
        """Receive a hold message with each motion owner, 0.2 s after the last one."""
        for self.owner in owners:
            self.clock.now += 0.2
            self.jogger.hold(page, "joint:a:+", press, self.rejected.append)


@pytest.fixture
def arm() -> Iterator[Arm]:
    clock = Clock()
    with use_time_source(clock):
        yield Arm(clock)


@pytest.mark.parametrize(("before", "then", "reason"), [
    (OURS, FREE, "press the button again"), (FREE, FREE, "its controller does not accept it"),
    (OURS, BOBS, "bob controls the arm"),
])
def test_held_button_without_effect_is_rejected_once_a_press_with_the_reason(
    arm: Arm, before: MotionOwner, then: MotionOwner, reason: str
) -> None:
    arm.hold(FREE, *[before] * 4, *[then] * 4)
    assert len(arm.rejected) == 1 and reason in arm.rejected[0]
    arm.hold(*[FREE] * 7, press=2)
    assert len(arm.rejected) == 2 and "its controller does not accept it" in arm.rejected[1]


@pytest.mark.parametrize("before", [OURS, FREE])
def test_button_that_asks_for_a_lost_direction_is_rejected_with_the_executors_reason(
    arm: Arm, before: MotionOwner
) -> None:
    arm.hold(FREE, *[before] * 2)
    arm.motion = MotionStatus(message=f"{ENDED} one is at its limit")
    arm.hold(*[FREE] * 7)
    assert arm.rejected == [f"Jogging rejected: {ENDED} one is at its limit"]
    jogs = arm.jogs
    arm.hold(FREE, press=2)
    assert arm.jogs == jogs, "the executor requires a pause"
    arm.hold(FREE, FREE, press=2)
    assert arm.jogs > jogs and len(arm.rejected) == 1


def test_one_page_jogs_at_a_time(arm: Arm) -> None:
    arm.hold(OURS, OURS)
    jogs = arm.jogs
    arm.hold(OURS, page="two")
    assert (arm.rejected, arm.jogs) == (["Another page is jogging the arm"], jogs)
    arm.hold(OURS)
    assert arm.jogs > jogs
    arm.clock.now += 1.0  # the earlier press has ended
    arm.hold(OURS, page="two", press=2)
    assert len(arm.rejected) == 1 and arm.jogs > jogs + 1


@pytest.mark.parametrize(("joints", "names"), [
    (["panda_joint1", "panda_joint2"], ["joint1", "joint2"]),
    (["shoulder_pan_joint", "elbow_joint"], ["joint shoulder pan", "joint elbow"]),
    (["1", "2"], ["joint 1", "joint 2"]),
])
async def test_jog_buttons_have_accessible_names(gui: viser.GuiApi, joints: list[str], names: list[str]) -> None:
    panel = JogPanel(gui, ActionQueue(), joints, [1.0, 1.0])
    labels = re.findall(r'aria-label="([^"]*)"', panel._html.content)
    tool = [f"{what} {axis}" for what in ("tool along", "rotate tool about") for axis in "xyz"]
    assert labels == [f"jog {name}, {sign}" for name in [*names, *tool] for sign in ("minus", "plus")]
