import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.ball_places import BallGeometry
from common.config import Container, Surroundings
from common.perception.pinhole import Pinhole

resting = BallGeometry.of(Surroundings())
camera = Pinhole.from_config(Surroundings().camera)


def test_heights_are_those_of_the_table_and_of_the_layers():
    assert resting.plane == pytest.approx(0.03)
    assert resting.layers == pytest.approx([0.035, 0.095])
    assert resting.stack_height == pytest.approx(0.125)


def test_stack_height_includes_higher_walls():
    assert BallGeometry(0.03, 0.1, Container(wall_height=0.3)).stack_height == pytest.approx(0.4)


unit = st.floats(-1, 1)


@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_ray_to_a_point_in_the_container_meets_it(inside, away):
    c, h = resting.container, resting.container.half_side
    point = np.array((c.x, c.y, 0.0625)) + 0.99 * np.array(inside) * (h, h, 0.0625)
    origin = point + np.array(away)
    if np.linalg.norm(away) > 1e-3:
        assert resting.meets_container(origin, point - origin)
        outside = np.abs(origin - (c.x, c.y, 0.0625)) > np.array((h, h, 0.0625)) + 1e-6
        if outside.any():
            assert not resting.meets_container(origin, origin - point), "it lies behind"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_an_axis_are_handled(axis):
    c = resting.container
    direction = np.eye(3)[axis]
    middle = np.array((c.x, c.y, 0.06))
    assert resting.meets_container(middle - direction, direction)
    assert not resting.meets_container(middle - direction + np.roll(direction, 1), direction)


def test_balls_above_the_table_lie_only_between_the_walls():
    c = resting.container
    assert resting.can_lie((0.2, -0.3, 0.03)) and resting.can_lie((c.x + 0.033, c.y - 0.033, 0.095))
    assert not resting.can_lie((0.2, -0.3, 0.095)) and not resting.can_lie((c.x + 0.07, c.y, 0.095))


def test_possible_heights_are_the_layers_or_the_table():
    c = resting.container
    assert resting.heights(camera, camera.project((c.x, c.y, 0.03))) == pytest.approx([0.035, 0.095])
    assert resting.heights(camera, camera.project((0.4, -0.3, 0.03))) == pytest.approx([0.03])
    thick = BallGeometry(0.03, 0.0, Container(floor_thickness=0.04))
    assert thick.heights(camera, camera.project((c.x, c.y, 0.03))) == pytest.approx([0.03, 0.07, 0.13])
