"""Find balls of known size and colour in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from common.config import Parameters, Surroundings
from common.perception.fit import Fit, fit_spheres
from common.perception.outline import Blob, Mask, find_blobs
from common.perception.pinhole import Pinhole
from common.perception.resting import Resting
from common.perception.separation import separate
from common.perception.sphere import ray_distances, silhouette

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

Hue = Annotated[int, Field(ge=0, le=180)]
Byte = Annotated[int, Field(ge=0, le=255)]
Hsv = tuple[Hue, Byte, Byte]


class DetectorOptions(Parameters):
    """How red is told from the rest. HSV as OpenCV has it: hue 0 to 180, saturation and value 0 to 255."""

    hsv_red_lo1: Hsv = Field((0, 120, 80), description="lower end of the first window: hue, saturation, value")
    hsv_red_hi1: Hsv = Field((10, 255, 255), description="upper end of the first window")
    hsv_red_lo2: Hsv = Field((170, 120, 80), description="lower end of the second window: red goes round the hue axis")
    hsv_red_hi2: Hsv = Field((180, 255, 255), description="upper end of the second window")
    morph_kernel_px: int = Field(7, ge=1, le=51, description="ellipse for opening, then closing [px]")
    min_contour_area_px: float = Field(400.0, gt=0, le=1e7, description="smaller blobs are ignored [px^2]")
    outline_offset_px: float = Field(
        -1.0, ge=-10, le=10, description="where the outline is expected, outside of the silhouette [px]"
    )
    max_offset_px: float = Field(
        2.0, gt=0, le=20, description="an outline that is further from where it is expected is not that of a ball [px]"
    )

    @model_validator(mode="after")
    def _windows_are_not_empty(self) -> DetectorOptions:
        for low, high in (("hsv_red_lo1", "hsv_red_hi1"), ("hsv_red_lo2", "hsv_red_hi2")):
            for name, a, b in zip("hsv", getattr(self, low), getattr(self, high), strict=True):
                if a > b:
                    raise ValueError(f"{low} {name} = {a} is above {high} {name} = {b}")
        return self


@dataclass(frozen=True)
class Detection:
    """A ball that was seen.

    Attributes:
        position: (3,) where the ray of its centre meets the plane of the centres of balls on the table [m], world.
        pixel: (u, v) where its centre is seen [px].
        area: of the blob that it is part of, divided by the balls in it [px^2].
        partial: reaches over the border of the picture.
        outline: (n, 2) its fitted silhouette [px].
    """

    position: tuple[float, float, float]
    pixel: tuple[float, float]
    area: float
    partial: bool
    outline: Array


class Detector:
    """Finds balls: the same picture always gives the same detections."""

    def __init__(self, surroundings: Surroundings, options: DetectorOptions | None = None) -> None:
        """Prepare for balls of the surroundings' size.

        Args:
            surroundings: radius of the balls, height of the table, container.
            options: colour windows and sizes.
        """
        self.options = options or DetectorOptions()
        self.resting = Resting.of(surroundings)
        size = self.options.morph_kernel_px
        self._kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))

    def masks(self, picture: Picture) -> tuple[Mask, Mask]:
        """What is red in a bgr8 picture: opened, and then closed; 255 where it is."""
        o = self.options
        hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
        low = cv2.inRange(hsv, np.array(o.hsv_red_lo1), np.array(o.hsv_red_hi1))
        high = cv2.inRange(hsv, np.array(o.hsv_red_lo2), np.array(o.hsv_red_hi2))
        opened = cv2.morphologyEx(cv2.bitwise_or(low, high), cv2.MORPH_OPEN, self._kernel)
        closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, self._kernel)
        return np.asarray(opened, np.uint8), np.asarray(closed, np.uint8)

    def detect(self, picture: Picture, camera: Pinhole) -> list[Detection]:
        """Balls in a bgr8 picture (height, width, 3), nearest to the upper left corner first."""
        fine, closed = self.masks(picture)
        blobs = find_blobs(closed, fine, camera, self.options.min_contour_area_px)
        pixel_size = self._pixel_size(camera)
        offset = self.options.outline_offset_px * pixel_size
        detections: list[Detection] = []
        crowded: list[Blob] = []
        offsets: list[float] = []
        for blob in blobs:
            fit, is_round = self._single(blob, camera, offset, pixel_size)
            if fit is not None:
                offsets.append(fit.offset)
                detections += self._detections(blob, fit, camera)
            elif not is_round:
                crowded.append(blob)
        # All outlines of a picture are off by as much: balls that stand alone say by how much.
        spread = 1.0 * pixel_size
        if offsets:
            offset, spread = float(np.median(offsets)), 0.2 * pixel_size
        for blob in crowded:
            detections += self._separated(blob, closed, camera, offset, spread)
        return sorted(detections, key=lambda d: (d.pixel[1], d.pixel[0]))

    def _pixel_size(self, camera: Pinhole) -> float:
        """Size of a pixel at the plane of the balls, below the camera [m]."""
        return abs(float(camera.position[2]) - self.resting.plane) / camera.fx

    def _single(self, blob: Blob, camera: Pinhole, offset: float, pixel_size: float) -> tuple[Fit | None, bool]:
        """The fit of a blob that is one round thing wholly in view, and whether it is round at all.

        The fit is None when it is not, and when it is round but as large as no ball looks where it can lie: that is
        something else, or a ball that is falling.
        """
        if len(blob.border) or len(blob.outline) < 12:
            return None, False
        center = camera.on_plane(blob.centroid, self.resting.plane)
        if not np.isfinite(center).all():
            return None, False
        ray = np.append(center, self.resting.plane) - camera.position
        best: Fit | None = None
        for z in self.resting.heights(camera, blob.centroid):
            start = ray * ((z - camera.position[2]) / ray[2])
            fit = fit_spheres(
                blob.outline, start[None], self.resting.radius, offset=offset, offset_std=1.0,
                gates=(self.resting.radius, 4 * pixel_size, 3 * pixel_size),
            )
            if np.count_nonzero(np.abs(fit.residuals) < 1.3 * pixel_size) < 0.96 * len(fit.residuals):
                return None, False
            if best is None or abs(fit.offset - offset) < abs(best.offset - offset):
                best = fit
        if best is None or abs(best.offset - offset) > self.options.max_offset_px * pixel_size:
            return None, True
        return best, True

    def _separated(self, blob: Blob, closed: Mask, camera: Pinhole, offset: float, spread: float) -> list[Detection]:
        """The balls of a blob that touch, hide each other or reach over the border."""
        outline = blob.outline
        centers = separate(outline, closed, camera, self.resting, offset)
        if not len(centers):
            return []
        fit = fit_spheres(outline, centers, self.resting.radius, offset=offset, offset_std=spread)
        return self._detections(blob, fit, camera)

    def _detections(self, blob: Blob, fit: Fit, camera: Pinhole) -> list[Detection]:
        found = []
        for center in fit.centers:
            pixel = camera.project(center + camera.position)
            place = camera.on_plane(pixel, self.resting.plane)
            if not (np.isfinite(pixel).all() and np.isfinite(place).all()):
                continue
            outline = silhouette(camera, center + camera.position, self.resting.radius, 32)
            partial = not camera.in_picture(outline).all() or self._cut(blob, center, camera)
            found.append(
                Detection(
                    position=(float(place[0]), float(place[1]), self.resting.plane),
                    pixel=(float(pixel[0]), float(pixel[1])),
                    area=blob.area / len(fit.centers),
                    partial=bool(partial),
                    outline=outline,
                )
            )
        return found

    def _cut(self, blob: Blob, center: Array, camera: Pinhole) -> bool:
        """Whether the picture's border cuts through the ball: the blob touches it there."""
        if not len(blob.border):
            return False
        distance, _ = ray_distances(camera.directions(blob.border), center[None])
        return bool((distance < self.resting.radius).any())
