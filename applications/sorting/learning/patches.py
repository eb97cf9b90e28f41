"""What the learned scorer sees of a grasp: heights around it in the grasp's frame, and numbers about it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.surface import Surface

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]

SIZE = 32  # cells of a side
STEP = 0.003  # [m] side of a cell
RANGE = 0.06  # [m] heights are clipped at this distance from the tool center point
SCALE = 0.03  # [m] that is 1


def patches_of(surface: Surface, T_world_closing: Array) -> Values:
    """Return heights (n, SIZE, SIZE) around grasps, in units of `SCALE`, against the approach.

    Rows run along x of the closing frame, columns along y, along which the fingers close. Where nothing was measured,
    the floor is assumed.

    Args:
        surface: seen from above.
        T_world_closing: (n, 4, 4) poses of the closing frame, z the approach.
    """
    count = len(T_world_closing)
    if count == 0:
        return np.zeros((0, SIZE, SIZE), np.float32)
    off = (np.arange(SIZE) - (SIZE - 1) / 2) * STEP
    x, y = np.meshgrid(off, off, indexing="ij")
    R, at = T_world_closing[:, :3, :3], T_world_closing[:, :3, 3]
    points = at[:, None, None] + x[..., None] * R[:, None, None, :, 0] + y[..., None] * R[:, None, None, :, 1]
    column = ((points[..., 0] - surface.origin[0]) / surface.step - 0.5).astype(np.float32)
    row = ((points[..., 1] - surface.origin[1]) / surface.step - 0.5).astype(np.float32)
    known = np.where(np.isnan(surface.top), np.float32(surface.floor), surface.top).astype(np.float32)
    flat = (count * SIZE, SIZE)
    top = np.concatenate([
        cv2.remap(known, column.reshape(flat)[part], row.reshape(flat)[part], cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_CONSTANT, borderValue=float(surface.floor))
        for part in (slice(begin, begin + 16384) for begin in range(0, flat[0], 16384))])  # remap's limit is 32767
    away = points - at[:, None, None]
    away[..., 2] = top.reshape(points.shape[:3]) - at[:, None, None, 2]
    against = -np.einsum("nijk,nk->nij", away, R[:, :, 2])
    return np.asarray(np.clip(against, -RANGE, RANGE) / SCALE, np.float32)
