"""A jog that ends around a late cycle, on an arm that trails its set-points."""

import numpy as np
import pytest

from common.control.executor import Executor
from common.hardware.lag import LagHardware
from common.hardware.mock import MockHardware
from tests.common.control.jogged_arm import arm

__all__ = ["arm"]


@pytest.mark.parametrize("gap", [0.01, 0.015, 0.025, 0.035, 0.06], ids="{} s".format)
def test_set_points_of_an_ended_jog_never_go_back_to_a_trailing_arm(arm, gap):
    arm.executor = Executor(LagHardware(arm.q.copy(), 0.1, None), arm.limits, arm.q, kinematics=arm.robot)
    arm.authority = arm.executor.authority
    arm.run(0.5)
    arm.jog_joint(0.6, 0.3)
    since = len(arm.sent)
    arm.step(gap)
    arm.run(1.5)
    steps = np.diff([q[0] for _, q in arm.sent[since - 1:]])
    assert (steps >= 0).all()
    assert not any(report.notes for report in arm.reports), "the arm was not moved from outside"


def test_arm_that_is_pushed_away_after_a_jog_is_held_where_it_is_found(arm):
    hardware = MockHardware(arm.q.copy(), None)
    arm.executor = Executor(hardware, arm.limits, arm.q, kinematics=arm.robot)
    arm.authority = arm.executor.authority
    arm.run(0.5)
    arm.jog_joint(0.4, 0.3)
    arm.run(0.3)
    hardware.write(arm.q + 0.05, np.zeros(arm.robot.dof), 0.0)
    arm.run(0.1)
    assert any("was moved from outside by 0.05" in note for report in arm.reports for note in report.notes)
