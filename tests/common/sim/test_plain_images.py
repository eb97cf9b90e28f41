import numpy as np
import pytest

from common.config import CameraConfig, Container, Surroundings
from common.perception.pinhole import Pinhole
from common.perception.sphere import ray_distances, silhouette
from tests.common.sim.spheres import draw_spheres

surroundings = Surroundings(container=Container())
camera = Pinhole.from_config(CameraConfig())
RED = np.array((26, 38, 255))


def red(picture):
    return (np.abs(picture.astype(int) - RED) < 12).all(axis=2)


def test_an_empty_table_is_grey_with_a_grid_every_40_pixels():
    picture = draw_spheres([], camera, surroundings)
    assert picture.shape == (480, 640, 3) and picture.dtype == np.uint8
    assert (picture[300, 300] == 128).all() and (picture[320, 301] == 108).all() and (picture[301, 320] == 108).all()
    assert not red(picture).any()


def test_the_box_is_drawn_where_the_camera_sees_its_rim():
    picture = draw_spheres([], camera, surroundings).astype(int)
    orange = (picture[..., 2] > 200) & (picture[..., 0] < 90)
    v, u = np.nonzero(orange)
    c = surroundings.container
    corners = [(c.x + dx, c.y + dy, c.wall_height) for dx in (-0.08, 0.08) for dy in (-0.08, 0.08)]
    rim = camera.project(corners)
    assert u.min() == pytest.approx(rim[:, 0].min(), abs=2) and v.min() == pytest.approx(rim[:, 1].min(), abs=2)
    assert u.max() < 320, "the box stands at +y, which is left in the picture"


def test_every_pixel_of_a_ball_lies_on_a_ray_that_meets_it():
    center = np.array((0.6, -0.35, 0.03))
    v, u = np.nonzero(red(draw_spheres([center], camera, surroundings)))
    distance, _ = ray_distances(camera.directions(np.column_stack([u, v])), center[None] - camera.position)
    assert distance.max() < 0.03
    outline = silhouette(camera, center, 0.03, 400)
    area = 0.5 * abs(np.sum(outline[:, 0] * np.roll(outline[:, 1], 1) - outline[:, 1] * np.roll(outline[:, 0], 1)))
    assert area - 230 < len(u) < area - 90, "the white rim takes the outermost pixel all the way round"


def test_what_is_nearer_hides_what_is_farther_in_any_order():
    low, high = (0.55, 0.25, 0.035), (0.55, 0.25, 0.095)
    one, other = (draw_spheres(order, camera, surroundings) for order in ([low, high], [high, low]))
    np.testing.assert_array_equal(one, other)
    u, v = camera.project(high).round().astype(int)
    assert red(draw_spheres([low, high], camera, surroundings))[v, u]


def test_the_outline_has_a_white_rim_of_two_pixels():
    picture = draw_spheres([(0.4, 0.0, 0.03)], camera, surroundings, rim_width=2)
    profile = picture[245, 320:350].astype(float)
    whiteness = (profile.min(axis=1) - 128).clip(0) / 127
    assert whiteness.sum() == pytest.approx(2, abs=0.3)


def test_noise_and_brightness_change_the_picture_as_told():
    plain = draw_spheres([(0.4, 0, 0.03)], camera, surroundings).astype(float)
    rng = np.random.default_rng(1)
    noisy = draw_spheres([(0.4, 0, 0.03)], camera, surroundings, noise_std=8, brightness=20, rng=rng).astype(float)
    background = (noisy - plain)[300:, :300]
    assert background.mean() == pytest.approx(20, abs=0.2) and background.std() == pytest.approx(8, abs=0.2)


def test_noise_of_the_same_seed_is_the_same():
    pictures = [draw_spheres([], camera, surroundings, noise_std=5, rng=np.random.default_rng(3)) for _ in range(2)]
    np.testing.assert_array_equal(*pictures)


def test_a_ball_out_of_view_or_above_the_camera_changes_nothing():
    empty = draw_spheres([], camera, surroundings)
    beyond = [(2.0, 0, 0.03), (0.4, 0, 0.9), (0.4, 0, 0.79)]
    np.testing.assert_array_equal(draw_spheres(beyond, camera, surroundings), empty)


def test_balls_have_the_colour_of_the_surroundings():
    blue = surroundings.model_copy(update={"ball_color": (0.0, 0.0, 1.0)})
    u, v = camera.project((0.4, 0.1, 0.03)).round().astype(int)
    assert draw_spheres([(0.4, 0.1, 0.03)], camera, blue)[v, u].tolist() == [255, 0, 0]
