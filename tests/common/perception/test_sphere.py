import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.config import CameraConfig
from common.perception.pinhole import Pinhole
from common.perception.sphere import ray_distances, silhouette

camera = Pinhole.from_config(CameraConfig())
places = st.tuples(st.floats(-0.2, 0.9), st.floats(-0.6, 0.6), st.floats(-0.2, 0.5))


@given(places, st.floats(0.005, 0.1))
def test_rays_through_the_silhouette_touch_the_sphere(center, radius):
    rays = camera.directions(silhouette(camera, center, radius))
    distance, _ = ray_distances(rays, np.array([center]) - camera.position)
    np.testing.assert_allclose(distance, radius, rtol=1e-9)


@given(places)
def test_gradient_of_ray_distance_is_the_unit_vector_to_the_center(center):
    rays = camera.directions(np.random.default_rng(1).uniform((0, 0), (640, 480), (20, 2)))
    c = np.array([center]) - camera.position
    distance, along = ray_distances(rays, c)
    gradient = (c - along * rays) / distance
    far = distance[:, 0] > 1e-3
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-7
        change = (ray_distances(rays, c + step)[0] - ray_distances(rays, c - step)[0])[:, 0] / 2e-7
        np.testing.assert_allclose(change[far], gradient[far, axis], atol=1e-4)


def test_sphere_on_the_axis_is_round_and_off_axis_elongated():
    below = silhouette(camera, (0.4, 0.0, 0.03), 0.03)
    np.testing.assert_allclose(np.linalg.norm(below - (320, 240), axis=1), 520 * 0.03 / np.sqrt(0.77**2 - 0.03**2))
    aside = silhouette(camera, (0.4, 0.4, 0.03), 0.03, 360)
    width, height = np.ptp(aside, axis=0)
    assert width > 1.1 * height


def test_silhouette_center_differs_from_the_projected_center():
    outline = silhouette(camera, (0.4, 0.4, 0.03), 0.03, 720)
    u = (outline[:, 0].min() + outline[:, 0].max()) / 2
    assert u - 320 == pytest.approx(-520 * 0.4 * 0.77 / (0.77**2 - 0.03**2), abs=0.01)
    assert u - camera.project((0.4, 0.4, 0.03))[0] < -0.3


@pytest.mark.parametrize("center", [(0.4, 0.0, 0.81), (0.4, 0.0, 1.0), (0.4, 0.0, 0.78)])
def test_sphere_at_or_behind_the_camera_has_no_silhouette(center):
    assert silhouette(camera, center, 0.03).shape == (0, 2)
