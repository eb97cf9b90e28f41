"""Fits of one sphere to each complete blob; a blob that is the same as in the last image is not fitted again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from applications.pick_place.ball_places import BallGeometry
from applications.pick_place.outliers import oval
from applications.pick_place.segmentation import Blob, OutlineKey, all_of
from applications.pick_place.sphere_fit import fit_each
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]

ROUND = 0.96  # fraction of an outline that must fit for a blob to be one ball
Key = tuple[OutlineKey, tuple[float, float], float]  # of a blob: outline, center [px], expected offset [m]


class Round(NamedTuple):
    """Fit of one sphere to a blob: center relative to the optical center [m], and its offset [m]."""

    center: Array
    offset: float
    close: float  # fraction of the outline that fits
    oval: float  # by which it is longer in one direction [m]


class SingleFits:
    """Fits balls on the table or on others; keeps the fits of the last image."""

    def __init__(self, resting: BallGeometry) -> None:
        """Fit balls that rest so."""
        self._resting = resting
        self._fits: dict[Key, list[Round]] = {}

    def clear(self) -> None:
        """Forget the last image."""
        self._fits.clear()

    def fit(
        self, blobs: list[Blob], camera: Pinhole, offset: float, pixel_size: float
    ) -> tuple[list[tuple[Blob, list[Round]]], list[Blob]]:
        """Fit one sphere at each possible height to every complete blob; return these, and the other blobs."""
        crowded: list[Blob] = []
        tried: list[tuple[Blob, Key]] = []
        starts: dict[Key, list[Array]] = {}  # of blobs that were not in the last image
        fits: dict[Key, list[Round]] = {}
        for blob in blobs:
            center = camera.on_plane(blob.centroid, self._resting.plane)
            if len(blob.border) or len(blob.outline) < 12 or not np.isfinite(center).all():
                crowded.append(blob)
                continue
            key = blob.traced, (float(blob.centroid[0]), float(blob.centroid[1])), offset
            if key in self._fits:
                fits[key] = self._fits[key]
            else:
                ray = np.append(center, self._resting.plane) - camera.position
                heights = self._resting.heights(camera, blob.centroid)
                starts[key], fits[key] = [ray * ((z - camera.position[2]) / ray[2]) for z in heights], []
            tried.append((blob, key))
        fitted = [(blob.outline, key, start) for blob, key in tried for start in starts.get(key, ())]
        if fitted:
            found = fit_each(
                *all_of([outline for outline, _, _ in fitted]), np.array([start for _, _, start in fitted]),
                self._resting.radius, offset=offset, close=1.3 * pixel_size,
                gates=(self._resting.radius, 4 * pixel_size, 3 * pixel_size),
            )
            for (outline, key, _), center, off, close in zip(fitted, *found, strict=True):
                longer = oval(outline, center, camera) if close >= ROUND else 0.0
                fits[key].append(Round(center, float(off), float(close), longer))
        self._fits = fits
        return [(blob, fits[key]) for blob, key in tried if fits[key]], crowded
