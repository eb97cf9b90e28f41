"""Overlap and containment of outlines seen from above."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from common.sim import footprints
from common.sim.footprints import overlap, within

SQUARE = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0, math.pi), st.floats(0.1, 1.5))
def test_squares_overlap_iff_they_share_a_point(x: float, y: float, yaw: float, s: float) -> None:
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    other = (s * (SQUARE - 0.5)) @ turn + (x, y)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 2), axis=-1).reshape(-1, 2)
    points = (s * grid) @ turn + (x, y)
    shared = bool(((points > 1e-3) & (points < 1 - 1e-3)).all(axis=1).any())
    if shared:
        assert overlap(SQUARE, other) and overlap(other, SQUARE)
    apart = (points < -0.1).any(axis=1) | (points > 1.1).any(axis=1)
    if apart.all():
        assert not overlap(SQUARE, other) and not overlap(other, SQUARE)


def test_touching_is_no_overlap_but_containment_is() -> None:
    assert not overlap(SQUARE, SQUARE + np.array([1.0, 0.0]))
    assert overlap(SQUARE, SQUARE)
    assert overlap(SQUARE, 0.2 * SQUARE + 0.4) and overlap(0.2 * SQUARE + 0.4, SQUARE)
    assert within(SQUARE, SQUARE) and within(0.2 * SQUARE, SQUARE) and not within(SQUARE + 0.01, SQUARE)


def test_square_fits_into_a_concave_corner() -> None:
    corner = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], dtype=float)
    assert not overlap(corner, 0.9 * SQUARE + 1.05)
    assert overlap(corner, SQUARE + 0.95)


def test_overlap_of_large_outlines_takes_bounded_work(monkeypatch) -> None:
    angles = np.linspace(0.0, 2 * math.pi, 60, endpoint=False)
    star = np.column_stack([np.cos(angles), np.sin(angles)]) * np.where(np.arange(60) % 2, 1.0, 0.5)[:, None]
    calls = Counter()
    for name in ("triangulate", "convex_overlap"):
        was = getattr(footprints, name)
        monkeypatch.setattr(footprints, name, lambda *a, was=was, name=name: (calls.update([name]), was(*a))[1])
    assert overlap(star, star + 0.3)
    assert not overlap(star, star + np.array([1.9, 0.5])), "one reaches between the teeth of the other"
    assert calls["triangulate"] == 4 and calls["convex_overlap"] < 60
