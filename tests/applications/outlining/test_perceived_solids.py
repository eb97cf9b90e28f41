import numpy as np
import pytest

from applications.outlining.contours import ContourOptions, find_contours
from applications.outlining.solids import perceived_solids, planning_scene
from common.config import Surroundings
from common.sim.objects import world_object
from tests.applications.outlining.outline_scenes import distances, seen, seen_world, upright, world


def solids_of(scene, channel="saturation"):
    camera, picture, depth = scene
    return perceived_solids(find_contours(picture, ContourOptions(channel=channel)), depth, camera)


def test_every_object_becomes_a_solid_with_position_and_height():
    solids = solids_of(seen_world("w5"))
    truth = [world_object(o) for o in world("w5").objects]
    assert len(solids) == len(truth)
    for thing in truth:
        middle = np.mean(thing.outline, axis=0)
        solid = min(solids, key=lambda s: float(np.linalg.norm(s.outline.mean(axis=0) - middle)))
        assert distances(solid.outline, thing.outline).max() < 1.3e-3 and len(solid.outline) < 30
        assert solid.base == pytest.approx(thing.base, abs=1e-5)
        assert solid.height == pytest.approx(thing.height, abs=1e-5)


def test_ring_is_one_solid_and_the_ground_none():
    assert len(solids_of(seen_world("w6"))) == 1
    assert len(solids_of(seen_world("w6"), "maximum")) == 1


def test_object_at_the_border_is_a_solid_as_far_as_visible():
    thing = upright(shape="box", x=0.5, y=0.25, size=(0.06, 0.06), height=0.05)
    solid, = solids_of(seen([thing]))
    assert solid.touches_border and solid.outline[:, 1].max() < 0.27 and solid.height == pytest.approx(0.05, abs=1e-5)


@pytest.mark.parametrize("none", [np.inf, np.finfo(np.float32).max, 1e9])
def test_invalid_depth_values_are_no_distances(none):
    camera, picture, depth = seen_world("w5")
    contours = find_contours(picture, ContourOptions())
    lies_on = depth > np.nanmax(depth) - 1e-3
    bare, known = (np.where(lies_on, np.float32(value), depth) for value in (none, np.nan))
    actual, expected = (planning_scene(Surroundings(), perceived_solids(contours, d, camera), 1) for d in (bare, known))
    assert actual == expected and actual.objects
