import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import CameraConfig
from common.messages import CameraInfo, Header
from common.perception.pinhole import CameraError, Pinhole
from common.robot.transforms import rpy_to_matrix, transform

angle = st.floats(-math.pi, math.pi)
default = Pinhole.from_config(CameraConfig())


def test_default_camera_is_a_rotation_and_not_a_mirror():
    R = default.T_world_optical[:3, :3]
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R, np.array([(0, -1, 0), (-1, 0, 0), (0, 0, -1)]).T, atol=1e-12)


@given(st.floats(0, 639), st.floats(0, 479), st.floats(0, 0.3))
def test_default_camera_maps_right_to_minus_y_and_down_to_minus_x(u, v, z):
    x, y = default.on_plane((u, v), z)
    h = 0.80 - z
    assert y == pytest.approx(0.0 - (u - 320) * h / 520, abs=1e-9)
    assert x == pytest.approx(0.40 - (v - 240) * h / 520, abs=1e-9)


def test_default_camera_shows_robot_left_as_left_and_far_as_up():
    middle, left, far = default.project([(0.4, 0, 0), (0.4, 0.2, 0), (0.6, 0, 0)])
    assert left[0] < middle[0] and left[1] == pytest.approx(middle[1])
    assert far[1] < middle[1] and far[0] == pytest.approx(middle[0])


def test_default_camera_sees_the_expected_area():
    corners = default.on_plane([(-0.5, -0.5), (639.5, 479.5)], 0.0)
    np.testing.assert_allclose(corners, [(0.769, 0.492), (0.031, -0.492)], atol=1.5e-3)


@given(st.tuples(angle, angle, angle), st.floats(1, 639), st.floats(1, 479), st.floats(0.1, 5))
def test_projection_inverts_rays_for_any_pose(rpy, u, v, distance):
    camera = Pinhole(500, 510, 310, 245, 640, 480, transform(rpy_to_matrix(*rpy), (0.3, -0.2, 0.9)))
    origin, direction = camera.ray((u, v))
    assert np.linalg.norm(direction) == pytest.approx(1)
    np.testing.assert_allclose(camera.project(origin + distance * direction), (u, v), atol=1e-6)
    assert np.linalg.det(camera.T_world_optical[:3, :3]) == pytest.approx(1)


@given(st.floats(0.1, 0.7), st.floats(-0.4, 0.4), st.floats(0, 0.2))
def test_on_plane_inverts_projection(x, y, z):
    np.testing.assert_allclose(default.on_plane(default.project((x, y, z)), z), (x, y), atol=1e-9)


def test_camera_info_and_its_pose_describe_the_same_camera():
    again = Pinhole.from_info(default.info(Header()), default.T_world_optical)
    points = np.random.default_rng(0).uniform((0.1, -0.4, 0), (0.7, 0.4, 0.3), (50, 3))
    np.testing.assert_array_equal(again.project(points), default.project(points))
    assert (again.width, again.height) == (640, 480)


def test_points_behind_the_camera_and_missed_planes_are_nan():
    assert np.isnan(default.project((0.4, 0.0, 0.9))).all()
    assert np.isnan(default.on_plane((320, 240), 0.9)).all()


def test_mirrored_or_non_rigid_pose_is_rejected():
    mirror = default.T_world_optical.copy()
    mirror[:3, 0] *= -1
    stretched = default.T_world_optical.copy()
    stretched[:3, :3] *= 1.1
    for T in (mirror, stretched):
        with pytest.raises(CameraError, match=r"determinant \+1"):
            Pinhole(520, 520, 320, 240, 640, 480, T)


def test_distortion_and_skew_are_rejected():
    k = [520.0, 0, 320, 0, 520, 240, 0, 0, 1]
    with pytest.raises(CameraError, match="distortion"):
        Pinhole.from_info(CameraInfo(header=Header(), height=480, width=640, d=[0.1, 0, 0, 0, 0], k=k), np.eye(4))
    k[1] = 3.0
    with pytest.raises(CameraError, match="intrinsic matrix"):
        Pinhole.from_info(CameraInfo(header=Header(), height=480, width=640, k=k), np.eye(4))


def test_image_border_is_half_a_pixel_beyond_the_outer_pixel_centers():
    inside = default.in_image([(-0.4, 10), (-0.6, 10), (639.4, 479.4), (100, 479.6)])
    assert inside.tolist() == [True, False, True, False]
    assert not default.in_image((3.0, 100.0), margin=5)
