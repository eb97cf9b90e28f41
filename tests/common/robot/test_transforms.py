import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from common.messages import Pose
from common.robot.transforms import (
    invert,
    matrix_to_pose,
    matrix_to_quaternion,
    matrix_to_rpy,
    pose_to_matrix,
    quaternion_to_matrix,
    rpy_to_matrix,
    tool_down,
    transform,
)

angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-2, 2)


@given(angles, angles, angles, lengths, lengths, lengths)
def test_pose_message_round_trip_preserves_the_matrix(roll, pitch, yaw, x, y, z):
    T = transform(rpy_to_matrix(roll, pitch, yaw), (x, y, z))
    assert np.allclose(pose_to_matrix(matrix_to_pose(T)), T, atol=1e-9)


@given(angles, angles, angles)
def test_rotations_are_proper(roll, pitch, yaw):
    R = rpy_to_matrix(roll, pitch, yaw)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert math.isclose(np.linalg.det(R), 1.0)
    assert np.allclose(quaternion_to_matrix(*matrix_to_quaternion(R)), R, atol=1e-9)


def test_quaternion_of_a_half_turn_is_exact():
    for axis in np.eye(3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        assert np.allclose(quaternion_to_matrix(*matrix_to_quaternion(R)), R)


def test_roll_pitch_yaw_turn_about_fixed_axes_in_this_order():
    expected = rpy_to_matrix(0, 0, 0.3) @ rpy_to_matrix(0, 0.2, 0) @ rpy_to_matrix(0.1, 0, 0)
    assert np.allclose(rpy_to_matrix(0.1, 0.2, 0.3), expected)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_roll_pitch_yaw_round_trip(roll, pitch, yaw):
    np.testing.assert_allclose(matrix_to_rpy(rpy_to_matrix(roll, pitch, yaw)), (roll, pitch, yaw), atol=1e-6)


@given(angles, st.sampled_from([np.pi / 2, -np.pi / 2]), angles)
def test_angles_at_a_pitch_of_90_degrees_give_the_same_rotation(roll, pitch, yaw):
    rotation = rpy_to_matrix(roll, pitch, yaw)
    np.testing.assert_allclose(rpy_to_matrix(*matrix_to_rpy(rotation)), rotation, atol=1e-6)


@given(angles)
def test_tool_down_points_down_at_any_yaw(yaw):
    T = tool_down(0.4, 0.1, 0.2, yaw)
    assert np.allclose(T[:3, 2], (0, 0, -1), atol=1e-12)
    assert np.allclose(T[:3, 0], (math.cos(yaw), math.sin(yaw), 0), atol=1e-12)
    assert np.allclose(T[:3, 3], (0.4, 0.1, 0.2))


def test_inverse_cancels_a_transform():
    T = transform(rpy_to_matrix(0.3, -0.2, 1.0), (0.1, 0.2, 0.3))
    assert np.allclose(invert(T) @ T, np.eye(4))
    assert matrix_to_pose(np.eye(4)) == Pose()
