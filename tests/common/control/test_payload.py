"""What the arm's controller is told that it carries."""

import numpy as np
import pytest

from common.config import GripperConfig
from common.control.executor import Executor
from common.hardware.interface import Limits
from common.hardware.mock import SimulatedFingers
from common.messages import ExecuteRequest, GripperCommand, Header, JointTrajectory
from tests.doubles.stopping_arm import StoppingArm

PAYLOAD = {"mass": 0.9, "com": [0, 0, 0.06], "held": [0, 0, 0.16]}
TWO = np.ones(2)
LIMITS = Limits(("shoulder", "elbow"), -3 * TWO, 3 * TWO, 2 * TWO, 10 * TWO)


class Rig:
    def __init__(self, **gripper: object) -> None:
        config = GripperConfig.model_validate({"joints": ["left", "right"], "links": [], **gripper})
        self.fingers = SimulatedFingers(config, 0.08)
        self.arm = StoppingArm(0 * TWO, self.fingers)
        self.cycle, self.now, self.notes = Executor(self.arm, LIMITS, 0 * TWO, gripper=config), 10.0, []
        self.run()

    def run(self, seconds: float = 0.5) -> list[tuple[object, ...]]:
        """What the arm was told since the last time."""
        before = len(self.arm.orders)
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            self.notes += self.cycle.cycle(Header(stamp=round(self.now * 1e9))).notes
        return self.arm.orders[before:]

    def move(self, trajectory: JointTrajectory) -> None:
        answer = self.cycle.execute(ExecuteRequest(id=f"{self.now:.2f}", trajectory=trajectory), self.now)
        assert answer.state == "active", answer

    def told(self, width: float, **more: float) -> list[tuple[object, ...]]:
        self.cycle.command_gripper(GripperCommand(id=f"{self.now:.2f}", width=width, **more), self.now)
        return self.run(1.5)


def test_controller_is_told_what_the_hand_carries_from_the_grasp_to_its_end():
    rig = Rig(payload=PAYLOAD)
    assert rig.arm.orders == [("payload", 0.9, 0.0, 0.0, 0.06)]
    rig.fingers.obstruct(0.05)
    (told,) = rig.told(0.0, expected_width=0.05, mass=0.3)
    assert told == ("payload", pytest.approx(1.2), 0.0, 0.0, pytest.approx((0.9 * 0.06 + 0.3 * 0.16) / 1.2))
    assert rig.told(0.08) == [("payload", 0.9, 0.0, 0.0, 0.06)]


def test_it_is_told_anew_when_the_arm_is_ready_again():
    rig = Rig(payload=PAYLOAD)
    rig.arm.stopped = True
    assert rig.run() == []
    rig.arm.stopped = False
    assert rig.run() == [("payload", 0.9, 0.0, 0.0, 0.06)]


def test_what_slipped_or_was_not_grasped_is_not_carried():
    rig = Rig(payload=PAYLOAD)
    assert rig.told(0.0, expected_width=0.05, mass=0.3) == []
    rig.fingers.obstruct(0.05)
    assert len(rig.told(0.0, expected_width=0.05, mass=0.3)) == 1
    rig.fingers.obstruct(0.0)
    assert rig.run() == [("payload", 0.9, 0.0, 0.0, 0.06)]


def test_nothing_is_told_where_the_robot_file_says_nothing_and_a_refusal_is_said_once():
    assert Rig().arm.orders == []
    rig = Rig(payload=PAYLOAD)
    rig.arm.refuses = "too heavy"
    rig.arm.stopped = True
    rig.run()
    rig.arm.stopped = False
    rig.run(3.0)
    assert [note for note in rig.notes if "payload" in note] == ["the arm did not accept its payload: too heavy"]


def test_what_came_to_nothing_is_told_again_after_a_motion(rest_to_rest):
    rig = Rig(payload=PAYLOAD)
    rig.fingers.obstruct(0.05)
    rig.arm.refuses = "cannot be set while the arm moves"
    first = rig.told(0.0, expected_width=0.05, mass=0.3)
    rig.arm.refuses = ""
    assert len(first) == 1 and rig.run() == []
    rig.move(rest_to_rest([0, 0], [0, 0.2]))
    moving = rig.run(0.1)
    assert not moving and rig.run(3.0) == first


def test_what_changes_while_the_arm_moves_is_told_when_it_rests(rest_to_rest):
    rig = Rig(payload=PAYLOAD)
    rig.fingers.obstruct(0.05)
    rig.told(0.0, expected_width=0.05, mass=0.3)
    rig.move(rest_to_rest([0, 0], [0, 0.2]))
    rig.run(0.1)
    rig.cycle.command_gripper(GripperCommand(id="let go", width=0.08), rig.now)
    assert rig.run(0.1) == [] and rig.run(3.0) == [("payload", 0.9, 0.0, 0.0, 0.06)]
