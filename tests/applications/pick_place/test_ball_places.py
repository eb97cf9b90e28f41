"""Where balls can lie: heights on the table and in the container, and which camera rays show its inside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.ball_places import BallGeometry
from common.config import Container, Surroundings
from common.perception.pinhole import Pinhole

AROUND = Surroundings()
BOX = AROUND.container
CAMERA = Pinhole.from_config(AROUND.camera)
BALLS = BallGeometry.of(AROUND)
INSIDE = [(0.55 + dx, 0.25 + dy, z) for dx in (-0.033, 0.033) for dy in (-0.033, 0.033) for z in (0.035, 0.095)]
OFF = BOX.half_side + 0.04 + AROUND.ball_radius
OUTSIDE = [(BOX.x - OFF, BOX.y, 0.03), (BOX.x, BOX.y - OFF, 0.03), (BOX.x + OFF, BOX.y + OFF, 0.03)]
unit = st.floats(-1, 1)


def test_pixel_of_a_ball_shows_whether_it_is_in_the_container():
    assert all(BALLS.shows_container(CAMERA, CAMERA.project(place)) for place in INSIDE)
    assert not any(BALLS.shows_container(CAMERA, CAMERA.project(place)) for place in OUTSIDE)


@given(st.floats(0, 639), st.floats(0, 479))
def test_ray_test_agrees_with_points_along_the_ray(u, v):
    origin, direction = CAMERA.ray((u, v))
    along = origin + np.linspace(0.6, 1.2, 4000)[:, None] * direction
    h = BOX.half_side
    within = (np.abs(along - (BOX.x, BOX.y, 0.0)) <= (h, h, 0.125)).all(axis=1) & (along[:, 2] >= 0)
    larger = (h + 0.001, h + 0.001, 0.126)
    grazing = (np.abs(along - (BOX.x, BOX.y, 0.0)) <= larger).all(axis=1) & (along[:, 2] >= -0.001)
    if within.any() or not grazing.any():
        assert BALLS.shows_container(CAMERA, (u, v)) == bool(within.any())


@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_ray_to_a_point_in_the_container_meets_it(inside, away):
    middle, half = (BOX.x, BOX.y, 0.0625), np.array((BOX.half_side, BOX.half_side, 0.0625))
    point = np.array(middle) + 0.99 * np.array(inside) * half
    origin = point + np.array(away)
    if np.linalg.norm(away) > 1e-3:
        assert BALLS.meets_container(origin, point - origin)
        if (np.abs(origin - middle) > half + 1e-6).any():
            assert not BALLS.meets_container(origin, origin - point), "it lies behind"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_an_axis_are_handled(axis):
    direction = np.eye(3)[axis]
    middle = np.array((BOX.x, BOX.y, 0.06))
    assert BALLS.meets_container(middle - direction, direction)
    assert not BALLS.meets_container(middle - direction + np.roll(direction, 1), direction)


def test_heights_are_those_of_the_table_and_of_the_layers():
    assert BALLS.plane == pytest.approx(0.03) and BALLS.layers == pytest.approx([0.035, 0.095])
    assert BALLS.stack_height == pytest.approx(0.125)
    assert BallGeometry(0.03, 0.1, Container(wall_height=0.3)).stack_height == pytest.approx(0.4)
    over_box, over_table = CAMERA.project((BOX.x, BOX.y, 0.03)), CAMERA.project((0.4, -0.3, 0.03))
    assert BALLS.heights(CAMERA, over_box) == pytest.approx([0.035, 0.095])
    assert BALLS.heights(CAMERA, over_table) == pytest.approx([0.03])
    thick = BallGeometry(0.03, 0.0, Container(floor_thickness=0.04))
    assert thick.heights(CAMERA, over_box) == pytest.approx([0.03, 0.07, 0.13])


def test_balls_above_the_table_lie_only_between_the_walls():
    assert BALLS.can_lie((0.2, -0.3, 0.03)) and BALLS.can_lie((BOX.x + 0.033, BOX.y - 0.033, 0.095))
    assert not BALLS.can_lie((0.2, -0.3, 0.095)) and not BALLS.can_lie((BOX.x + 0.07, BOX.y, 0.095))
