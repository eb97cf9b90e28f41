import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from common.messages import Pose
from common.robot import transforms as t

angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-2, 2)


@given(angles, angles, angles, lengths, lengths, lengths)
def test_pose_message_round_trip_and_inverse_preserve_the_matrix(roll, pitch, yaw, x, y, z):
    T = t.transform(t.rpy_to_matrix(roll, pitch, yaw), (x, y, z))
    assert np.allclose(t.pose_to_matrix(t.matrix_to_pose(T)), T, atol=1e-9)
    assert np.allclose(t.invert(T) @ T, np.eye(4)) and t.matrix_to_pose(np.eye(4)) == Pose()


@given(angles, angles, angles)
def test_rotations_are_proper(roll, pitch, yaw):
    R = t.rpy_to_matrix(roll, pitch, yaw)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12) and math.isclose(np.linalg.det(R), 1.0)
    assert np.allclose(t.quaternion_to_matrix(*t.matrix_to_quaternion(R)), R, atol=1e-9)


def test_quaternion_of_a_half_turn_is_exact():
    for axis in np.eye(3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        assert np.allclose(t.quaternion_to_matrix(*t.matrix_to_quaternion(R)), R)


def test_roll_pitch_yaw_turn_about_fixed_axes_in_this_order():
    expected = t.rpy_to_matrix(0, 0, 0.3) @ t.rpy_to_matrix(0, 0.2, 0) @ t.rpy_to_matrix(0.1, 0, 0)
    assert np.allclose(t.rpy_to_matrix(0.1, 0.2, 0.3), expected)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_roll_pitch_yaw_round_trip(roll, pitch, yaw):
    np.testing.assert_allclose(t.matrix_to_rpy(t.rpy_to_matrix(roll, pitch, yaw)), (roll, pitch, yaw), atol=1e-6)


@given(angles, st.sampled_from([np.pi / 2, -np.pi / 2]), angles)
def test_angles_at_a_pitch_of_90_degrees_give_the_same_rotation(roll, pitch, yaw):
    R = t.rpy_to_matrix(roll, pitch, yaw)
    np.testing.assert_allclose(t.rpy_to_matrix(*t.matrix_to_rpy(R)), R, atol=1e-6)


@given(angles)
def test_tool_down_points_down_at_any_yaw(yaw):
    T = t.tool_down(0.4, 0.1, 0.2, yaw)
    assert np.allclose(T[:3, 2], (0, 0, -1), atol=1e-12)
    assert np.allclose(T[:3, 0], (math.cos(yaw), math.sin(yaw), 0), atol=1e-12)
    assert np.allclose(T[:3, 3], (0.4, 0.1, 0.2))
