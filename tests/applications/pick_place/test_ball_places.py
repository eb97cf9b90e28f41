"""Which camera rays show the inside of the container."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from applications.pick_place.ball_places import BallGeometry
from common.config import Surroundings
from common.perception.pinhole import Pinhole

AROUND = Surroundings()
BOX = AROUND.container
CAMERA = Pinhole.from_config(AROUND.camera)
INSIDE = [(0.55 + dx, 0.25 + dy, z) for dx in (-0.033, 0.033) for dy in (-0.033, 0.033) for z in (0.035, 0.095)]
OFF = BOX.half_side + 0.04 + AROUND.ball_radius
OUTSIDE = [(BOX.x - OFF, BOX.y, 0.03), (BOX.x, BOX.y - OFF, 0.03), (BOX.x + OFF, BOX.y + OFF, 0.03)]


@pytest.mark.parametrize(("position", "inside"), [*((p, True) for p in INSIDE), *((p, False) for p in OUTSIDE)])
def test_ray_to_a_ball_shows_whether_it_is_in_the_container(position, inside):
    assert BallGeometry.of(AROUND).shows_container(CAMERA, CAMERA.project(position)) == inside


@given(st.floats(0, 639), st.floats(0, 479))
def test_ray_test_agrees_with_points_along_the_ray(u, v):
    origin, direction = CAMERA.ray((u, v))
    along = origin + np.linspace(0.6, 1.2, 4000)[:, None] * direction
    h = BOX.half_side
    within = (np.abs(along - (BOX.x, BOX.y, 0.0)) <= (h, h, 0.125)).all(axis=1) & (along[:, 2] >= 0)
    larger = (h + 0.001, h + 0.001, 0.126)
    grazing = (np.abs(along - (BOX.x, BOX.y, 0.0)) <= larger).all(axis=1) & (along[:, 2] >= -0.001)
    if within.any() or not grazing.any():
        assert BallGeometry.of(AROUND).shows_container(CAMERA, (u, v)) == bool(within.any())
