"""Contours to fractions of a pixel: from how much of each pixel at the edge an object covers."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from applications.outlining.evening import evened

Array = npt.NDArray[np.float64]

REACH = 3.0  # the channel is looked at so far to both sides of a contour [px]
STEP = 0.25  # [px]
LEVELS = 2.0  # from here on outwards it is that of the object, or of what is beside it [px]
LEAST_CONTRAST = 20.0  # [0..255]
NEIGHBOURS = 2  # points to each side from which the direction of the edge is found


def normals(points: npt.ArrayLike, *, hole: bool) -> Array:
    """Unit vectors (n, 2) out of the object at each point of a closed contour (n, 2); zero where there is none."""
    p = np.asarray(points, dtype=float)
    tangent = sum(np.roll(p, -k, axis=0) - np.roll(p, k, axis=0) for k in range(1, NEIGHBOURS + 1))
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    x, y = p.T
    turn = np.sign(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) * (-1 if hole else 1)
    across = np.column_stack([tangent[:, 1], -tangent[:, 0]]) * turn
    return np.asarray(np.divide(across, length, out=np.zeros_like(across), where=length > 1e-9))


def refine(channel: npt.NDArray[np.uint8], chain: npt.NDArray[np.int32], *, hole: bool) -> Array:
    """The points of a closed contour (n, 2) [px], each moved across the edge to where the edge really is.

    A pixel has the mean of what it sees. The step from inside to outside, summed up along a line across it, then
    tells where on that line a straight edge lies, whatever its direction. Where there is no clear step (another object
    is too near) a point stays in the middle between the last pixel inside and the first one outside.
    """
    out = normals(chain, hole=hole)
    along = np.arange(-REACH, REACH + STEP / 2, STEP)
    at = chain[:, None, :] + along[None, :, None] * out[:, None, :]
    profile = _sample(channel, at)
    inner, outer = np.median(profile[:, along <= -LEVELS], axis=1), np.median(profile[:, along >= LEVELS], axis=1)
    contrast = inner - outer
    clear = contrast >= LEAST_CONTRAST
    share = np.clip((profile - outer[:, None]) / np.where(clear, contrast, 1.0)[:, None], 0.0, 1.0)
    weights = np.full(len(along), STEP)
    weights[[0, -1]] = STEP / 2
    offset = np.where(clear, np.clip(share @ weights - REACH, -1.0, 1.5), 0.5)
    return evened(np.asarray(chain + offset[:, None] * out))


def _sample(channel: npt.NDArray[np.uint8], at: Array) -> Array:
    """Values (n, m) between the pixels at places (n, m, 2) [px]; beyond the border those of the border."""
    places = at.astype(np.float32)
    rows = 32000  # cv2.remap takes no more
    parts = [
        cv2.remap(channel.astype(np.float32), part[..., 0], part[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        for part in np.array_split(places, max(1, -(-len(places) // rows)))
    ]
    return np.concatenate(parts).astype(float)
