"""The force sensor of the physics arm against known weights and a push, and the estimate made of it."""

from typing import Any

import numpy as np
import pytest

from common.control.force_sensing import ForceSensing
from common.control.wrench import GRAVITY, Payload
from common.messages import Header
from common.robot.tool_mass import described_tool
from common.robot.transforms import invert
from tests.drivers.mujoco.test_physics import CUBE, Rig

TURNED = [0.3, -0.5, 0.2, -1.9, 0.4, 2.6, -0.9]


class Sensing(Rig):
    """A rig with a wrench estimate that knows the described mass of the gripper."""

    def begin(self, q: Any) -> None:
        super().begin(q)
        mass, com = described_tool(self.robot)
        self.force = ForceSensing(self.arm, self.robot, "tcp", self.robot.config.gripper,
                                  described=Payload(mass, *com))
        self.held = 0.0

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            self.now += 0.01
            q, dq = self.arm.read(self.now)
            self.force.update(self.now, q, dq, self.held, at_rest=True)

    @property
    def in_world(self) -> tuple[np.ndarray, np.ndarray]:
        """Raw force (3,) [N] and its torque about the flange (3,) [N m], along the axes of world."""
        raw, rotation = self.arm.wrench(), self.T_world_flange[:3, :3]
        return rotation @ raw[:3], rotation @ raw[3:]

    @property
    def T_world_flange(self) -> np.ndarray:  # noqa: N802
        return self.robot.fk(self.arm.read(self.now)[0]) @ invert(self.robot.T_flange_tcp)

    @property
    def wrench(self) -> np.ndarray:
        return self.force.estimator.wrench


@pytest.mark.parametrize("pose", ["home", TURNED])
def test_sensor_reads_the_weight_of_the_gripper_in_every_orientation(pose: Any) -> None:
    rig = Sensing()
    rig.move(rig.robot.named(pose) if isinstance(pose, str) else pose)
    rig.wait(0.5)
    mass, com = described_tool(rig.robot)
    force, torque = rig.in_world
    arm = rig.T_world_flange[:3, :3] @ com
    assert force == pytest.approx([0, 0, -mass * GRAVITY], abs=0.01)
    assert torque == pytest.approx(np.cross(arm, [0, 0, -mass * GRAVITY]), abs=0.01)
    assert np.abs(rig.wrench).max() < 0.02


def test_held_object_pulls_down_until_its_mass_is_known() -> None:
    rig = Sensing({**CUBE, "mass": 0.5})
    rig.grasp(effort=40.0)
    rig.wait(0.5)
    down = rig.robot.fk(rig.set_point)[:3, :3].T @ [0, 0, -0.5 * GRAVITY]
    assert rig.wrench[:3] == pytest.approx(down, abs=0.05)
    rig.held = 0.5
    rig.wait(0.5)
    assert np.abs(rig.wrench[:3]).max() < 0.05


def test_table_pushes_the_tool_up() -> None:
    rig = Sensing()
    rig.move(rig.above(0.45, 0.0, 0.02))
    rig.wait(0.3)
    rig.force.zero()
    rig.move(rig.above(0.45, 0.0, -0.002), seconds=2.0)
    rig.wait(0.5)
    up = rig.robot.fk(rig.set_point)[:3, :3] @ rig.wrench[:3]
    assert up[2] > 2.0 and np.abs(up[:2]).max() < 0.5 * up[2]
    message = rig.force.message(Header())
    assert message.zeroed and message.force.z < -2.0 and not message.reason  # the tool points down
    rig.move(rig.above(0.45, 0.0, 0.02))
    rig.wait(0.3)
    assert np.abs(rig.wrench).max() < 0.05
