"""Projection of points and of spheres."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import CameraConfig
from common.messages import CameraInfo, Header
from common.perception.pinhole import CameraError, Pinhole, ray_distances, silhouette
from common.robot.transforms import rpy_to_matrix, transform

angle = st.floats(-math.pi, math.pi)
places = st.tuples(st.floats(-0.2, 0.9), st.floats(-0.6, 0.6), st.floats(-0.2, 0.5))
default = Pinhole.from_config(CameraConfig())


@given(st.floats(0, 639), st.floats(0, 479), st.floats(0, 0.3))
def test_default_camera_maps_right_to_minus_y_and_down_to_minus_x(u, v, z):
    h = 0.80 - z
    x, y = 0.40 - (v - 240) * h / 520, 0.0 - (u - 320) * h / 520
    np.testing.assert_allclose(default.on_plane((u, v), z), (x, y), atol=1e-9)
    np.testing.assert_allclose(default.project((x, y, z)), (u, v), atol=1e-6)


@given(st.tuples(angle, angle, angle), st.floats(1, 639), st.floats(1, 479), st.floats(0.1, 5))
def test_projection_inverts_rays_for_any_pose(rpy, u, v, distance):
    camera = Pinhole(500, 510, 310, 245, 640, 480, transform(rpy_to_matrix(*rpy), (0.3, -0.2, 0.9)))
    origin, direction = camera.ray((u, v))
    assert np.linalg.norm(direction) == pytest.approx(1)
    np.testing.assert_allclose(camera.project(origin + distance * direction), (u, v), atol=1e-6)
    assert np.linalg.det(camera.T_world_optical[:3, :3]) == pytest.approx(1)


def test_camera_info_and_its_pose_describe_the_same_camera():
    again = Pinhole.from_info(default.info(Header()), default.T_world_optical)
    points = np.random.default_rng(0).uniform((0.1, -0.4, 0), (0.7, 0.4, 0.3), (50, 3))
    np.testing.assert_array_equal(again.project(points), default.project(points))
    assert (again.width, again.height) == (640, 480)


def test_points_behind_the_camera_and_missed_planes_are_nan():
    assert np.isnan(default.project((0.4, 0.0, 0.9))).all()
    assert np.isnan(default.on_plane((320, 240), 0.9)).all()


@pytest.mark.parametrize("change", [np.diag([-1, 1, 1, 1]), np.diag([1.1, 1.1, 1.1, 1])], ids=["mirror", "stretch"])
def test_mirrored_or_non_rigid_pose_is_rejected(change):
    with pytest.raises(CameraError, match=r"determinant \+1"):
        Pinhole(520, 520, 320, 240, 640, 480, default.T_world_optical @ change)


@pytest.mark.parametrize(("d", "skew", "text"), [([0.1, 0, 0, 0, 0], 0.0, "distortion"), ([], 3.0, "intrinsic matrix")])
def test_distortion_and_skew_are_rejected(d, skew, text):
    k = [520.0, skew, 320, 0, 520, 240, 0, 0, 1]
    with pytest.raises(CameraError, match=text):
        Pinhole.from_info(CameraInfo(header=Header(), height=480, width=640, d=d, k=k), np.eye(4))


def test_image_border_is_half_a_pixel_beyond_the_outer_pixel_centers():
    inside = default.in_image([(-0.4, 10), (-0.6, 10), (639.4, 479.4), (100, 479.6)])
    assert inside.tolist() == [True, False, True, False] and not default.in_image((3.0, 100.0), margin=5)


# --- spheres ---


@given(places, st.floats(0.005, 0.1))
def test_rays_through_the_silhouette_touch_the_sphere(center, radius):
    rays = default.directions(silhouette(default, center, radius))
    distance, _ = ray_distances(rays, np.array([center]) - default.position)
    np.testing.assert_allclose(distance, radius, rtol=1e-9)


@given(places)
def test_gradient_of_ray_distance_is_the_unit_vector_to_the_center(center):
    rays = default.directions(np.random.default_rng(1).uniform((0, 0), (640, 480), (20, 2)))
    c = np.array([center]) - default.position
    distance, along = ray_distances(rays, c)
    gradient = (c - along * rays) / distance
    far = distance[:, 0] > 1e-3
    for axis, step in enumerate(1e-7 * np.eye(3)):
        change = (ray_distances(rays, c + step)[0] - ray_distances(rays, c - step)[0])[:, 0] / 2e-7
        np.testing.assert_allclose(change[far], gradient[far, axis], atol=1e-4)


def test_silhouette_is_round_on_the_axis_and_elongated_and_shifted_off_it():
    below = silhouette(default, (0.4, 0.0, 0.03), 0.03)
    np.testing.assert_allclose(np.linalg.norm(below - (320, 240), axis=1), 520 * 0.03 / np.sqrt(0.77**2 - 0.03**2))
    outline = silhouette(default, (0.4, 0.4, 0.03), 0.03, 720)
    width, height = np.ptp(outline, axis=0)
    assert width > 1.1 * height
    u = (outline[:, 0].min() + outline[:, 0].max()) / 2
    assert u - 320 == pytest.approx(-520 * 0.4 * 0.77 / (0.77**2 - 0.03**2), abs=0.01)
    assert u - default.project((0.4, 0.4, 0.03))[0] < -0.3


@pytest.mark.parametrize("center", [(0.4, 0.0, 0.81), (0.4, 0.0, 1.0), (0.4, 0.0, 0.78)])
def test_sphere_at_or_behind_the_camera_has_no_silhouette(center):
    assert silhouette(default, center, 0.03).shape == (0, 2)
