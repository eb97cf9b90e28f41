import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from applications.pick_place.segmentation import Outline, all_of
from applications.pick_place.sphere_fit import fit_each, fit_spheres
from common.config import CameraConfig
from common.perception.pinhole import Pinhole, silhouette

camera = Pinhole.from_config(CameraConfig())
R = 0.03


def outline_of(center, radius=R, part=slice(None)):
    """Exact outline of a sphere, or a part of it."""
    pixels = silhouette(camera, center, radius, 120)[part]
    rays = camera.directions(pixels)
    c = np.array(center) - camera.position
    toward = c - (rays @ c)[:, None] * rays
    return Outline(pixels, rays, toward / np.linalg.norm(toward, axis=1, keepdims=True))


def joined(*outlines):
    return Outline(*(np.concatenate([getattr(o, name) for o in outlines]) for name in ("pixels", "rays", "inward")))


places = st.tuples(st.floats(0.1, 0.7), st.floats(-0.4, 0.4), st.just(0.03))
steps = st.tuples(st.floats(-0.006, 0.006), st.floats(-0.006, 0.006), st.just(0.0))


@given(st.lists(st.tuples(places, steps, st.floats(-0.002, 0.002)), min_size=1, max_size=4))
@settings(deadline=None)
def test_spheres_and_offsets_are_fitted_from_nearby_values(spheres):
    centers = np.array([center for center, _, _ in spheres])
    starts = centers + [step for _, step, _ in spheres] - camera.position
    outlines = [outline_of(center, R + offset) for center, _, offset in spheres]
    gates = (0.02, 0.01, 0.005, 0.003)
    found, offsets, close = fit_each(*all_of(outlines), starts, R, offset=0.0, gates=gates, close=1e-4)
    np.testing.assert_allclose(found + camera.position, centers, atol=2e-5)
    np.testing.assert_allclose(offsets, [offset for _, _, offset in spheres], atol=2e-5)
    assert (close == 1).all()


@given(places, steps, st.integers(0, 119), st.integers(50, 100))
def test_partial_outline_with_known_offset_is_enough(center, step, first, length):
    outline = outline_of(center, R - 0.001, (first + np.arange(length)) % 120)
    start = np.array([center]) + step - camera.position
    gates = (0.02, 0.02, 0.01, 0.01, 0.005, 0.005)
    found, offsets, _ = fit_each(*all_of([outline]), start, R, offset=-0.001, gates=gates, close=1e-3, hold_offset=True)
    np.testing.assert_allclose(found[0] + camera.position, center, atol=2e-5)
    assert offsets[0] == -0.001


@given(places, st.floats(-0.002, 0.002), st.floats(-1, 1))
@settings(deadline=None)
def test_touching_spheres_are_fitted_with_their_offset(center, offset, angle):
    other = np.array(center) + 2 * R * np.array((np.cos(angle), np.sin(angle), 0))
    outline = joined(outline_of(center, R + offset), outline_of(other, R + offset))
    start = np.array([center, other]) + np.array((0.003, -0.002, 0)) - camera.position
    fit = fit_spheres(outline, start, R, offset=0.0, offset_std=1.0)
    np.testing.assert_allclose(fit.centers + camera.position, [center, other], atol=2e-5)
    assert fit.offset == pytest.approx(offset, abs=2e-5)
    assert (fit.owner == np.repeat([0, 1], 120)).mean() > 0.95


def test_points_off_all_outlines_are_ignored():
    center = np.array((0.4, 0.1, 0.03))
    stray = outline_of(center + np.array((0.05, 0, 0)), 0.01)
    fit = fit_spheres(joined(outline_of(center), stray), center[None] - camera.position, R, offset=0.0, offset_std=1e-3)
    np.testing.assert_allclose(fit.centers[0] + camera.position, center, atol=1e-5)
    assert (fit.owner[:120] == 0).all() and (fit.owner[120:] == -1).all()


def test_fit_without_points_keeps_the_initial_values():
    guess = np.array([(0.4, 0.0, 0.03)]) - camera.position
    fit = fit_spheres(outline_of((0.4, 0.0, 0.03), part=slice(0, 0)), guess, R, offset=-0.001, offset_std=1e-3)
    np.testing.assert_allclose(fit.centers, guess)
    assert fit.offset == pytest.approx(-0.001)
    points = all_of([outline_of((0.6, 0.2, 0.03))])
    elsewhere, _, close = fit_each(*points, guess, R, offset=0.0, gates=(0.01,), close=0.001)
    np.testing.assert_allclose(elsewhere, guess, atol=1e-9)
    assert close[0] == 0
