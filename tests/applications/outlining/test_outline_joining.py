"""What closes the gaps of an outline whose ends lie far from each other, as wrong depths have it."""

import tracemalloc

import numpy as np

from applications.outlining.top_face import joined


def test_very_long_gap_adds_no_more_points_than_others():
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
