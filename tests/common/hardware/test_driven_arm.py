"""Messages of a driver process, for an arm controlled by the test."""

import multiprocessing
import time
from types import SimpleNamespace

import pytest

from common.hardware import driven_arm
from common.hardware.driven_arm import TIMEOUT, DrivenArm, Player, Reading
from common.hardware.driver_process import DriverProcess
from common.hardware.interface import ArmState, HardwareFault, Limits, Vector
from common.hardware.streaming import SetPointStream

ENDED = "its program has ended"


class EndingArm:
    """An arm at rest whose program ends right after the first reading; the third reading fails."""

    rate, paced_by_arm, realtime = 500.0, True, False

    def __init__(self) -> None:
        self._states = [ArmState([0.0] * 2, [0.0] * 2, "running", ""), ArmState([0.0] * 2, [0.0] * 2, "idle", ENDED)]

    def read(self) -> ArmState:
        if not self._states:
            raise EOFError
        return self._states.pop(0)

    def due(self) -> list[float]:
        return []

    def servo(self, points: list[Vector]) -> None:
        """Ignore set-points."""

    def wait(self) -> None:
        """Return at once."""


def test_change_right_after_a_reading_is_reported_before_the_arm_falls_silent(limits: Limits) -> None:
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        player = Player(EndingArm(), SetPointStream(limits, 0.05, 0.002), theirs)  # type: ignore[arg-type]
        with pytest.raises(EOFError):
            while True:
                player.cycle()
        readings = list[Reading]()
        while ours.poll():
            readings.append(ours.recv())
    assert [reading.state.message for reading in readings] == ["", ENDED]


@pytest.mark.parametrize(("ago", "age", "known"), [
    (0.0, 0.0, True), (0.0, 1.5 * TIMEOUT, True), (1.5 * TIMEOUT, 0.0, False), (0.0, 2.5 * TIMEOUT, False),
    (0.9 * TIMEOUT, 1.5 * TIMEOUT, False),
])
def test_arm_is_disconnected_without_messages_or_with_too_old_a_state(
    limits: Limits, monkeypatch: pytest.MonkeyPatch, ago: float, age: float, known: bool,
) -> None:
    monkeypatch.setattr(DriverProcess, "keep_running", lambda _process: None)  # the test sends the messages
    arm = DrivenArm("none", {}, limits, gripper=None, ahead=0.1, delay=0.0, name="arm")
    state = ArmState([0.1] * 2, [0.0] * 2, "running", age=age)
    now = time.monotonic()
    monkeypatch.setattr(driven_arm, "time", SimpleNamespace(monotonic=lambda: now))
    arm._process.on_message(Reading(now - ago, state, 0, "", 0.0))
    assert arm.state.mode == ("running" if known else "disconnected")
    if known:
        assert list(arm.read(0.0)[0]) == state.q
    else:
        with pytest.raises(HardwareFault, match="no message from arm for"):
            arm.read(0.0)
