"""Segments are numbered from 1, whatever was joined before."""

import numpy as np

from applications.sorting.segments import SMALLEST, _numbered


def test_segment_of_two_colors_that_was_joined_to_a_smaller_label_is_no_error():
    side = int(SMALLEST**0.5) + 1
    labels = np.zeros((side, 3 * side), np.int32)
    labels[:, side:2 * side] = 1
    labels[:, 2 * side:] = 2
    found = _numbered(labels, {2, 6})  # 6 has become a part of 2
    assert (found.count, found.patched) == (2, {2})
