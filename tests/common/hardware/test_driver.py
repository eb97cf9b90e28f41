"""What the process of a driver tells, of an arm that does what a test wants it to."""

import multiprocessing
import time

import pytest

from common.hardware.driver import SILENT, DrivenArm, Reading, _follow
from common.hardware.driver_process import DriverProcess
from common.hardware.interface import ArmState, HardwareFault, Limits, Vector
from common.hardware.streaming import SetPointStream

ENDED = "its program has ended"


class Ending:
    """At rest; its program ends at once after it was read, and nothing is heard while the next one is loaded."""

    rate, paces, hurries = 500.0, True, False

    def __init__(self) -> None:
        self._states = [ArmState([0.0] * 2, [0.0] * 2, "running", ""), ArmState([0.0] * 2, [0.0] * 2, "idle", ENDED)]

    def read(self) -> ArmState:
        if not self._states:
            raise EOFError
        return self._states.pop(0)

    def due(self) -> list[float]:
        return []

    def servo(self, points: list[Vector]) -> None:
        """Nothing is sent to it."""

    def wait(self) -> None:
        """It waits for nobody."""

    def do(self, act: str, *values: float) -> None:
        """Nothing is asked of it."""

    def close(self) -> None:
        """There is nothing to let go of."""


def test_what_happens_right_after_a_reading_is_told_before_the_arm_falls_silent(limits: Limits) -> None:
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        with pytest.raises(EOFError):
            _follow(Ending(), SetPointStream(limits, 0.05, 0.002), theirs)
        told = list[Reading]()
        while ours.poll():
            told.append(ours.recv())
    assert [reading.state.message for reading in told] == ["", ENDED]


@pytest.mark.parametrize(("ago", "age", "heard"), [
    (0.0, 0.0, True), (0.0, 1.5 * SILENT, True), (1.5 * SILENT, 0.0, False), (0.0, 2.5 * SILENT, False),
    (0.9 * SILENT, 1.5 * SILENT, False),
])
def test_an_arm_is_silent_when_its_process_says_nothing_or_for_too_long_nothing_new_of_it(
    limits: Limits, monkeypatch: pytest.MonkeyPatch, ago: float, age: float, heard: bool,
) -> None:
    monkeypatch.setattr(DriverProcess, "keep_up", lambda _process: None)  # nobody is there but this test
    arm = DrivenArm("none", {}, limits, gripper=None, ahead=0.1, delay=0.0, name="arm")
    state = ArmState([0.1] * 2, [0.0] * 2, "running", age=age)
    arm._hear(Reading(time.monotonic() - ago, state, 0, "", 0.0))
    assert arm.state.mode == ("running" if heard else "disconnected")
    if heard:
        assert list(arm.read(0.0)[0]) == state.q
    else:
        with pytest.raises(HardwareFault, match="no word from arm for"):
            arm.read(0.0)
