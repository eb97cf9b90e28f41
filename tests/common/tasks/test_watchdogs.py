"""The liveness watchdog on a fake clock, then with both tasks."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common import messages as m
from common.tasks.monitoring import LOOK_PERIOD, LivenessWatchdog
from tests.applications.outlining.outline_double import OutlineDouble
from tests.applications.pick_place.cell_double import CellDouble

PLANNER, EXECUTOR = "motion_planner", "trajectory_executor"


class Setting:
    """Joint states at a rate, a planner and an executor, watched by a task 20 times a second."""

    def __init__(self, rate: float = 100.0, **motion: object) -> None:
        self.rate, self.motion, self.now = rate, m.MotionStatus(**{"id": "a", "state": "active", **motion}), 100.0
        self.there = {PLANNER: True, EXECUTOR: True}
        self.came = 0.0
        self.asked: list[m.HoldRequest] = []
        self.watchdog = LivenessWatchdog(lambda: int(self.came), lambda: 0.2)

    def wait(self, seconds: float, step: float = LOOK_PERIOD) -> list[bool]:
        """The holds (True) and releases (False) that were asked for meanwhile."""
        before, end = len(self.asked), self.now + seconds
        while self.now < end - 1e-9:
            self.now += step
            self.came += step * self.rate
            self.asked += self.watchdog.update(self.now, dict(self.there), self.motion)
        return [hold.hold for hold in self.asked[before:]]


@pytest.fixture
def setting() -> Setting:
    setting = Setting()
    assert setting.wait(5) == [] and setting.watchdog.trouble == ""
    return setting


def test_missing_joint_states_hold_the_arm_until_they_return(setting: Setting) -> None:
    setting.rate = 0.0
    assert setting.wait(0.2) == []
    assert setting.wait(0.1) == [True]
    assert setting.asked[-1].by == "watchdog" and setting.asked[-1].reason == "no joint states for 200 ms"
    assert setting.wait(60) == []
    setting.rate = 100.0
    assert setting.wait(0.1) == [False]
    assert setting.wait(60) == [] and setting.watchdog.trouble == ""


@pytest.mark.parametrize("name", [PLANNER, EXECUTOR])
def test_missing_service_holds_the_arm_until_everything_is_back(setting: Setting, name: str) -> None:
    setting.there[name] = False
    assert setting.wait(0.1) == [True] and setting.asked[-1].reason == f"{name} is gone"
    setting.rate = 0.0
    assert setting.wait(1) == []
    setting.rate = 100.0
    assert setting.wait(1) == []
    setting.there[name] = True
    assert setting.wait(1) == [False]


def test_no_hold_without_motion_but_the_fault_is_known() -> None:
    setting = Setting(state="none")
    setting.wait(1)
    setting.there[PLANNER] = False
    assert setting.wait(1) == [] and setting.watchdog.trouble == "motion_planner is gone"


def test_service_never_seen_is_not_missing() -> None:
    setting = Setting(rate=0.0)
    setting.there = {PLANNER: False, EXECUTOR: False}
    assert setting.wait(10) == [] and setting.watchdog.trouble == ""


@pytest.mark.parametrize("late", [0.5, 2.0, 60.0])
def test_own_delay_is_no_fault(setting: Setting, late: float) -> None:
    setting.now += late  # neither the task nor the robot ran
    assert setting.wait(0.3) == []


def test_late_joint_state_on_a_busy_machine_is_no_fault() -> None:
    setting = Setting()
    setting.wait(5, step=0.3)
    setting.rate = 0.0
    assert setting.wait(0.6, step=0.3) == []
    assert setting.wait(6.0, step=0.3) == [True], "but a silence is"


def test_slow_joint_states_are_not_missing() -> None:
    setting = Setting(rate=2.0)
    assert setting.wait(20)[1:] in ([], [False])  # at first it is not known that they are so slow
    assert setting.wait(60) == []
    setting.rate = 0.0
    assert setting.wait(6) == [True]


def test_hold_of_an_earlier_process_is_adopted() -> None:
    assert Setting(held=True, held_by=["watchdog"]).wait(0.1) == [False]


@given(st.lists(st.tuples(st.sampled_from(["joints", PLANNER, EXECUTOR]), st.floats(0.01, 3.0)), max_size=12))
def test_holds_and_releases_alternate(events: list[tuple[str, float]]) -> None:
    setting = Setting()
    setting.wait(1)
    for what, seconds in events:
        if what == "joints":
            setting.rate = 100.0 - setting.rate
        else:
            setting.there[what] = not setting.there[what]
        setting.wait(seconds)
    setting.rate, setting.there = 100.0, {PLANNER: True, EXECUTOR: True}
    setting.wait(1)
    holds = [hold.hold for hold in setting.asked]
    assert holds == [True, False] * (len(holds) // 2)


# --- with the tasks ---

Double = CellDouble | OutlineDouble
BOTH = pytest.mark.parametrize(("make", "stage"), [
    (lambda: CellDouble([(0.40, -0.30)]), "pre-grasp"), (OutlineDouble, "trace")], ids=["pick_place", "outline"])


@BOTH
def test_no_motion_starts_during_a_fault_and_none_is_repeated(make: Callable[[], Double], stage: str) -> None:
    cell, trouble = make(), ""
    view = cell.view

    def troubled() -> object:
        seen = view()
        seen.trouble = trouble
        return seen

    def executed() -> list[str]:
        return [request.id for request in cell.requests if isinstance(request, m.ExecuteRequest)]

    cell.view = troubled  # type: ignore[assignment,method-assign]
    cell.until(stage)
    trouble = "motion_planner is gone"
    before = executed()
    for _ in range(100):
        cell.step()
    assert executed() == before and cell.motion.state == "succeeded", "the active motion may end"
    trouble = ""
    cell.until("DONE")
    assert len(executed()) == len(set(executed())) and cell.task.status.failures == 0


@BOTH
def test_watchdog_hold_found_at_the_start_does_not_pause(make: Callable[[], Double], stage: str) -> None:
    cell = make()
    cell.motion = m.MotionStatus(held=True, held_by=["watchdog"])
    cell.step()
    assert not cell.task.status.paused
    cell.motion = m.MotionStatus()
    cell.until("DONE")
