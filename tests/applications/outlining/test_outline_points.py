"""Points of outlines: without duplicates, simplified, and with closed gaps."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from applications.outlining.solids import simplified, without_duplicates
from applications.outlining.top_face import joined, rounded
from tests.applications.outlining.outline_scenes import dense, distances

FEW = st.integers(0, 5).map(lambda n: n / 1e3)
MILLIMETERS = arrays(float, st.tuples(st.integers(1, 40), st.just(3)), elements=FEW)


@given(points=MILLIMETERS)
def test_no_consecutive_points_are_equal(points):
    remaining = without_duplicates(points)
    assert {tuple(p) for p in remaining} == {tuple(p) for p in points}
    if len(remaining) > 1:
        assert (np.abs(remaining - np.roll(remaining, 1, axis=0)).max(axis=1) > 0).all()


def test_points_repeated_later_remain():
    eight = np.array([[0, 0], [1, 1], [0, 2], [-1, 1], [0, 0], [1, -1], [0, -2]], float)
    np.testing.assert_array_equal(without_duplicates(eight), eight)
    np.testing.assert_array_equal(without_duplicates([[0, 0], [0, 0], [1, 0], [1, 0], [0, 0]]), [[0, 0], [1, 0]])


@given(seed=st.integers(0, 10**6), tolerance=st.sampled_from([1e-5, 1e-4, 1e-3]))
def test_simplified_outline_stays_within_tolerance_with_the_same_first_point(seed, tolerance):
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2 * np.pi, 150, endpoint=False)
    radius = 0.05 + rng.normal(0, tolerance / 2, 150) + 0.01 * np.sin(rng.integers(1, 5) * angles)
    points = np.column_stack([radius * np.cos(angles), radius * np.sin(angles)])
    remaining = simplified(points, tolerance)
    assert distances(points, remaining).max() <= tolerance + 1e-12
    assert distances(dense(remaining, 1e-3), points).max() <= tolerance + 1e-12
    np.testing.assert_array_equal(remaining[0], points[0])
    assert len(remaining) <= len(points)


def test_square_is_reduced_to_its_corners_and_rounded():
    corners = np.array([[0, 0], [0.1, 0], [0.1, 0.1], [0, 0.1]])
    square = dense(corners, 0.002)
    np.testing.assert_allclose(simplified(square, 5e-5), corners, atol=1e-12)
    assert simplified(square, 0.0) is square
    points = np.array([[0.12345, -0.5001, 1.0004]])
    np.testing.assert_allclose(rounded(points, 0.001), [[0.123, -0.5, 1.0]], atol=1e-12)
    assert rounded(points, 0.0) is points


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points_stay_unchanged(count):
    points = np.arange(3.0 * count).reshape(count, 3)
    np.testing.assert_array_equal(simplified(without_duplicates(points), 1.0), points)


def test_very_long_gap_between_wrong_depths_adds_no_more_points_than_others():
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    edge = 1e-4 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    far = edge + np.where(turn < np.pi, 0.0, 1.0)[:, None] * [1.0, 0.0, 0.0]
    tracemalloc.start()
    try:
        points = joined(far, 20 * edge[:, :2] / 1e-4, turn < np.pi, 1e-5, edge)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert len(points) > len(far) and np.isfinite(points).all()
