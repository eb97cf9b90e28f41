"""The payload that the arm's own controller gets: at rest, after a grasp and after a release."""

import numpy as np
import pytest

from common.config import GripperConfig
from common.control.executor import Executor
from common.hardware.mock import SimulatedFingers
from common.messages import ExecuteRequest, GripperCommand, Header
from tests.doubles.stopping_arm import StoppingArm

PAYLOAD = {"mass": 0.9, "com": [0, 0, 0.06], "held": [0, 0, 0.16]}
EMPTY = ("payload", 0.9, 0.0, 0.0, 0.06)
GRASP = {"width": 0.0, "expected_width": 0.05, "mass": 0.3}


class PayloadRig:
    def __init__(self, limits, **gripper):
        config = GripperConfig.model_validate({"joints": ["left", "right"], "links": [], **gripper})
        self.fingers = SimulatedFingers(config)
        self.arm = StoppingArm(np.zeros(2), self.fingers)
        self.executor, self.now, self.notes = Executor(self.arm, limits, np.zeros(2), gripper=config), 10.0, []
        self.run()

    def run(self, seconds=0.5):
        """Run cycles; return the orders that the arm got."""
        before = len(self.arm.orders)
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            self.notes += self.executor.cycle(Header(stamp=round(self.now * 1e9))).notes
        return self.arm.orders[before:]

    def move(self, trajectory):
        answer = self.executor.execute(ExecuteRequest(id=f"{self.now:.2f}", trajectory=trajectory), self.now)
        assert answer.state == "active", answer

    def grip(self, seconds=1.5, **command):
        self.executor.command_gripper(GripperCommand(id=f"{self.now:.2f}", **command), self.now)
        return self.run(seconds)


@pytest.fixture
def rig(limits):
    """The gripper, with an object between its fingers."""
    rig = PayloadRig(limits, payload=PAYLOAD)
    assert rig.arm.orders == [EMPTY]
    rig.fingers.obstruct(0.05)
    return rig


def test_held_object_counts_from_the_grasp_to_the_release(rig, limits):
    (order,) = rig.grip(**GRASP)
    assert order == ("payload", pytest.approx(1.2), 0.0, 0.0, pytest.approx((0.9 * 0.06 + 0.3 * 0.16) / 1.2))
    assert rig.grip(width=0.08) == [EMPTY]
    rig.arm.stopped = True
    assert rig.run() == []
    rig.arm.stopped = False
    assert rig.run() == [EMPTY], "sent again as the arm's controller may have restarted"
    assert PayloadRig(limits).arm.orders == [], "there is none in the robot file"


def test_object_that_slipped_or_was_not_grasped_does_not_count(rig):
    rig.fingers.obstruct(0.0)
    assert rig.grip(**GRASP) == []
    rig.fingers.obstruct(0.05)
    assert len(rig.grip(**GRASP)) == 1
    rig.fingers.obstruct(0.0)
    assert rig.run() == [EMPTY]



def test_refused_payload_is_logged_once_and_sent_again_after_a_motion(rig, rest_to_rest):
    rig.arm.refuses = "cannot be set while the arm moves"
    first = rig.grip(**GRASP)
    rig.arm.refuses = ""
    assert len(first) == 1 and rig.run(3.0) == []
    assert rig.notes == ["the arm did not accept its payload: cannot be set while the arm moves"]
    rig.move(rest_to_rest([0, 0], [0, 0.2]))
    assert rig.run(0.1) == [] and rig.run(3.0) == first


def test_change_during_a_motion_is_sent_at_rest(rig, rest_to_rest):
    rig.grip(**GRASP)
    rig.move(rest_to_rest([0, 0], [0, 0.2]))
    rig.run(0.1)
    assert rig.grip(0.1, width=0.08) == [] and rig.run(3.0) == [EMPTY]
