"""The surface that depth cameras see from above: heights, colors and what is unknown, on a grid in world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights on a grid of square cells seen from above: row i, column j is at `origin + step * (j + 0.5, i + 0.5)`.

    Attributes:
        origin: (x, y) of the corner of cell (0, 0) in world [m]; columns run along world x, rows along world y.
        step: side of a cell [m].
        top: (rows, columns) float32, z of the highest measured point in world [m]; NaN where nothing was measured.
        color: (rows, columns, 3) uint8, blue green red; 0 where nothing was measured.
        floor: z of the floor of the tray or table under the grid [m].
    """

    origin: tuple[float, float]
    step: float
    top: npt.NDArray[np.float32]
    color: npt.NDArray[np.uint8]
    floor: float

    def xy(self, row: npt.ArrayLike, column: npt.ArrayLike) -> Array:
        """World (..., 2) [m] of cell centers."""
        x = self.origin[0] + self.step * (np.asarray(column, float) + 0.5)
        y = self.origin[1] + self.step * (np.asarray(row, float) + 0.5)
        return np.stack(np.broadcast_arrays(x, y), axis=-1)

    def cells(self, xy: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """(..., 2) row and column of the cells that contain world positions (..., 2) [m]; may be outside the grid."""
        at = (np.asarray(xy, float) - self.origin) / self.step
        return np.floor(at[..., ::-1]).astype(np.int64)
