"""The shape of grippers, measured from the robots' collision geometry."""

from __future__ import annotations

import numpy as np
import pytest

from applications.sorting.grasps.gripper_shape import GripperShape
from common.config.loading import load_robot
from common.errors import ConfigError
from common.planning.robot_geometry import RobotGeometry
from common.robot.finger_joints import closing_frame
from common.robot.model import RobotModel


def shape_of(robot: str) -> GripperShape:
    return GripperShape.of(RobotGeometry(RobotModel.load(load_robot(robot))))


@pytest.mark.parametrize(("robot", "half_width", "thickness", "length", "width"), [
    ("panda", 0.009, 0.015, 0.047, 0.08),  # as in Franka's meshes
    ("ur5", 0.011, 0.014, 0.074, 0.085),  # as in robotiq_2f85.urdf
])
def test_fingers_are_measured(robot: str, half_width: float, thickness: float, length: float, width: float) -> None:
    shape = shape_of(robot)
    assert shape.pad_half_width == pytest.approx(half_width, abs=0.001)
    assert shape.finger_thickness == pytest.approx(thickness, abs=0.001)
    assert shape.finger_length == pytest.approx(length, abs=0.001)
    assert shape.max_width == width
    hand = load_robot(robot).gripper
    assert hand is not None
    np.testing.assert_array_equal(shape.T_tcp_closing, closing_frame(hand))


@pytest.mark.parametrize("robot", ["panda", "ur5"])
@pytest.mark.parametrize("width", [0.0, 0.033, 0.08])
def test_fingers_are_a_width_apart_on_both_sides(robot: str, width: float) -> None:
    shape = shape_of(robot)
    T = np.eye(4)[None]
    _, y, z = shape.finger_surfaces.placed(T, np.array([width]))[:, 0]
    tips = z > z.max() - 0.01
    assert y[tips & (y > 0)].min() == pytest.approx(width / 2, abs=0.0015)
    assert y[tips & (y < 0)].max() == pytest.approx(-width / 2, abs=0.0015)
    assert z.max() == pytest.approx(float(shape.tip(width)), abs=1e-4)


def test_tips_of_linked_fingers_reach_farther_while_they_close() -> None:
    shape = shape_of("ur5")
    assert shape.tip(0.0) - shape.tip(0.085) == pytest.approx(0.0132, abs=0.0005)  # by the linkage's formula
    assert np.ptp(shape_of("panda").tip([0.0, 0.04, 0.08])) == 0.0


def test_samples_are_placed_by_the_pose_of_the_gripper() -> None:
    shape = shape_of("panda")
    T = np.array([[0, 1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, -1, 0.1], [0, 0, 0, 1.0]])
    local = shape.surfaces.placed(np.eye(4)[None], np.array([0.05]))[:, 0]
    placed = shape.surfaces.placed(T[None], np.array([0.05]))[:, 0]
    np.testing.assert_allclose(placed, T[:3, :3] @ local + T[:3, 3:], atol=1e-6)


def test_a_robot_without_fingers_is_rejected() -> None:
    config = load_robot("panda").model_copy(update={"gripper": None})
    with pytest.raises(ConfigError, match=r"robot\.gripper"):
        GripperShape.of(RobotGeometry(RobotModel.load(config)))
