"""Faults of arm and gripper: they end the goal, are reported once, and are over when the device works again."""

import numpy as np
import pytest

from common.hardware.interface import GripperReading, HardwareFault
from common.hardware.mock import MockHardware, SimulatedFingers
from common.messages import GripperState, MotionStatus
from common.transport.codec import decode, encode
from tests.common.control.rig import GRIPPER, START, ExecutorRig

FAR = [0.5, 0.5]


def failing_with(error):
    def fail(*_):
        raise error

    return fail


class Broken(MockHardware):
    """Hardware whose method `failing` raises `error`, and which counts that."""

    def __init__(self):
        super().__init__(START, SimulatedFingers(GRIPPER))
        self.failing, self.error, self.failed = "", None, 0

    def call(self, method):
        if method == self.failing:
            self.failed += 1
            raise self.error

    def read(self, now):
        self.call("read")
        return super().read(now)

    def write(self, positions, velocities, now):
        self.call("write")
        super().write(positions, velocities, now)


@pytest.fixture
def rig(limits, rest_to_rest):
    rig = ExecutorRig(limits, Broken())
    rig.step()
    rig.execute("a", rest_to_rest([0, 0], FAR, 2.0))
    return rig


@pytest.mark.parametrize("failing", ["read", "write"])
@pytest.mark.parametrize("error", [
    HardwareFault("cable is off"), HardwareFault(), OSError(5, "no route"), KeyError("q")])
def test_failing_backend_is_left_alone_and_recovers_by_itself(rig, rest_to_rest, failing, error):
    hardware = rig.hardware
    rig.run(0.3)
    hardware.failing, hardware.error = failing, error
    notes = rig.run(1.0)
    assert hardware.failed <= 4 and len(notes) == 1 and notes[0].startswith("the arm does not work: ")
    aborted = rig.motions[-1]
    assert (aborted.state, aborted.error, aborted.source) == ("aborted", "hardware_fault", "hardware")
    assert aborted.message and aborted.message in notes[0]
    refused = rig.execute("b", rest_to_rest([0, 0], FAR))
    assert refused.error == "hardware_fault" and refused.message in notes[0]
    if failing == "read":
        assert rig.step().joints is None, "no invented joint state"
    rig.run(10.0)
    assert hardware.failed <= 6
    hardware.failing = ""
    hardware._positions, hardware._velocities = np.array([0.3, -0.2]), START  # it has sagged meanwhile
    notes = rig.run(6.0)
    assert len(notes) == 1 and notes[0].startswith("the arm works again")
    assert rig.joints[-1].position[:2] == [0.3, -0.2] and not any(rig.joints[-1].velocity[:2])
    assert rig.execute("c", rest_to_rest([0.3, -0.2], FAR)).state == "active"


NOT_TWO = "reading joints: positions are not 2 finite numbers"


@pytest.mark.parametrize(("reading", "message"), [
    ((np.zeros(3), START), NOT_TWO), ((np.array([np.nan, 0.0]), START), NOT_TWO),
    ((np.array([1e300, 0.0]), START), NOT_TWO), ((None, START), NOT_TWO), (([None, 0.0], START), NOT_TWO),
    (None, "reading joints: "), ((START,), "reading joints: "), ((["a", "b"], START), "reading joints: "),
])
def test_invalid_joint_reading_is_a_fault_and_moves_nothing(limits, reading, message):
    rig = ExecutorRig(limits, Broken())
    rig.step()
    rig.hardware.read = lambda now: reading
    report = rig.step()
    assert report.notes[0].startswith(f"the arm does not work: {message}") and report.joints is None
    assert "hardware fault" in rig.motions[-1].message


@pytest.mark.parametrize("device", ["arm", "gripper"])
def test_message_of_a_fault_with_any_characters_can_be_sent(rig, monkeypatch, device):
    rig.grip("close", 0.0)
    fault = HardwareFault(b"\xff\x1b[2J".decode(errors="surrogateescape"))
    monkeypatch.setattr(rig.hardware if device == "arm" else rig.hardware.gripper, "read", failing_with(fault))
    rig.run(1.0)
    status = decode(MotionStatus, encode(rig.motions[-1]))
    assert status.message == r"\udcff\x1b[2J" and status == rig.motions[-1]
    assert decode(GripperState, encode(rig.grippers[-1])) == rig.grippers[-1]


@pytest.mark.parametrize("reading", [
    GripperReading(np.nan, 0.0, False, False), GripperReading(0.05, np.inf, True, False), None,
    GripperReading(0.05, 0.0, False, False, np.inf), GripperReading(None, 0.0, False, False),
])
def test_invalid_gripper_reading_is_a_fault_of_the_gripper(rig, monkeypatch, reading):
    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "read", lambda now: reading)
        notes = rig.run(1.0)
        assert len(notes) == 1 and notes[0].startswith("the gripper does not work: reading the gripper: ")
        assert (rig.motions[-1].state, rig.motions[-1].error) == ("aborted", "hardware_fault")
    rig.run(6.0)
    assert rig.grip("again", 0.08).state == "active"


def test_numpy_numbers_are_valid_gripper_readings(rig, monkeypatch):
    reading = GripperReading(np.float32(0.05), np.float32(0.0), np.bool_(False), np.bool_(True), np.float32(1.0))
    monkeypatch.setattr(rig.hardware.gripper, "read", lambda now: reading)
    rig.step()
    assert decode(GripperState, encode(rig.grippers[-1])).width == pytest.approx(0.05)


def test_failing_gripper_brakes_the_arm_which_is_held_and_refuses_goals(rig, rest_to_rest, monkeypatch):
    silent = failing_with(TimeoutError("no answer"))
    rig.run(0.2)
    rig.grip("close", 0.0)
    rig.run(0.1)
    with monkeypatch.context() as broken:
        broken.setattr(rig.hardware.gripper, "read", silent)
        assert rig.run(1.0) == ["the gripper does not work: reading the gripper: TimeoutError: no answer"]
        for state in (rig.motions[-1], rig.grippers[-1]):
            assert (state.state, state.error) == ("aborted", "hardware_fault")
        assert 0 < rig.joints[-1].position[0] < 0.2 and not any(rig.joints[-1].velocity[:2])
        assert rig.execute("b", rest_to_rest(rig.joints[-1].position[:2], FAR)).error == "hardware_fault"
        assert rig.grip("open", 0.08).error == "hardware_fault"
    for goal, fail, message in (("again", silent, "moving the gripper: TimeoutError: no answer"),
                                ("still", failing_with(HardwareFault()), "moving the gripper: HardwareFault")):
        rig.run(6.0)
        with monkeypatch.context() as broken:
            broken.setattr(rig.hardware.gripper, "command", fail)
            assert rig.grip(goal, 0.08).message == message
    rig.run(6.0)
    assert rig.grip("now", 0.08).state == "active"
    assert rig.execute("c", rest_to_rest(rig.joints[-1].position[:2], FAR)).state == "active"
