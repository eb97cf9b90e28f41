"""The fastest speeds along a path, by the kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.planning.kernel.library import library
from common.planning.kernel.world import address

Array = NDArray[np.float64]


def fastest(lengths: Array, up: Array, down: Array, slope: Array, most: Array) -> tuple[Array, Array] | int | None:
    """x (N + 1,) at the grid points and u (N,) between them, with -down - slope x <= u <= up - slope x.

    A grid point where the way on is too fast, or N more than one that cannot be left, where there are no such speeds.
    None where the kernel is not built.

    Args:
        lengths: (N,); up, down, slope: (N, rows); most: (N + 1,) x at most.
    """
    found = library()
    if found is None:
        return None
    count, rows = up.shape
    given = [np.ascontiguousarray(values, dtype=float) for values in (lengths, up, down, slope)]
    highest, x, u = np.array(most, dtype=float), np.empty(count + 1), np.empty(count)
    failed = int(found.zk_speeds(count, rows, *(address(values) for values in (*given, highest, x, u))))
    return (x, u) if failed < 0 else failed
