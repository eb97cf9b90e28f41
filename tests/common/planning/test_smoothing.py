
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.planning.path import smoothed


def bending(points):
    """Integral of the square of the curvature along a line [1/m]."""
    edges = np.diff(points, axis=0)
    lengths = np.linalg.norm(edges, axis=1)
    directions = edges / lengths[:, None]
    between = (lengths[:-1] + lengths[1:]) / 2
    return float(((np.diff(directions, axis=0) ** 2).sum(axis=1) / between).sum())


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 200), st.floats(1e-5, 1e-3), st.integers(0, 1000))
def test_points_stay_within_their_tolerances_and_the_ends_where_they_are(count, tolerance, seed):
    rng = np.random.default_rng(seed)
    points = np.cumsum(rng.uniform(-1e-3, 1e-3, (count, 3)) + np.array([1e-3, 0, 0]), axis=0)
    tolerances = tolerance * rng.uniform(0, 1, count)
    moved = smoothed(points, tolerances)
    assert (np.linalg.norm(moved - points, axis=1) <= tolerances + 1e-12).all()
    assert np.array_equal(moved[[0, -1]], points[[0, -1]])


@pytest.mark.parametrize("radius", [0.005, 0.05])
def test_circle_with_noise_becomes_round(radius):
    rng = np.random.default_rng(1)
    angles = np.cumsum(rng.uniform(4e-4, 1e-3, round(radius * 6000)) / radius)
    points = np.column_stack([np.cos(angles), np.sin(angles)]) * radius
    noisy = points + rng.uniform(-3e-5, 3e-5, points.shape)
    noisy[[0, -1]] = points[[0, -1]]
    moved = smoothed(noisy, np.full(len(points), 6e-5))
    assert bending(moved) < 1.1 * bending(points)
    assert np.linalg.norm(moved - points, axis=1).max() < 1.5e-4


def test_straight_line_stays_as_it_is():
    points = np.linspace([0, 0, 0], [0.1, 0.05, 0], 101)
    assert np.abs(smoothed(points, np.full(101, 1e-4)) - points).max() < 1e-9


def test_what_may_not_move_and_what_is_too_short_to_bend_stay():
    corner = np.array([[0, 0], [0.001, 0], [0.001, 0.001]], dtype=float)
    assert np.array_equal(smoothed(corner, np.zeros(3)), corner)
    assert np.array_equal(smoothed(corner[:2], np.ones(2)), corner[:2])
