"""Find balls of known size and color in an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from applications.pick_place.ball_places import BallGeometry, shows_table
from applications.pick_place.container_floor import ContainerFloor
from applications.pick_place.depth_spheres import find_balls_in_depth
from applications.pick_place.outliers import (
    BELOW,
    BLURRED,
    COVERED,
    EXPLAINED,
    FALLING,
    FLAT,
    LONG,
    MOST_OVAL,
    MOST_UNLIKE,
    NOT_ROUND,
    THIN,
    Outlier,
    covered,
    sized,
    unlike,
)
from applications.pick_place.segmentation import (
    Blob,
    Colours,
    Mask,
    Masks,
    Outline,
    OutlineKey,
    RedMasks,
    blob_centers,
    find_blobs,
    long_components,
    small_blobs,
)
from applications.pick_place.single_fits import ROUND, SingleFits
from applications.pick_place.sphere_fit import Fit, fit_spheres, separate
from common.config import CameraConfig, Parameters, Surroundings, Tunable
from common.perception.depth import Depth
from common.perception.illumination import BoolMask, blank_image_reason, sampled_pixels
from common.perception.labels import draw_labels
from common.perception.pinhole import Pinhole, ray_distances, silhouettes

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

_LEAST_TABLE = 0.1  # smallest fraction of the image that shows the table, to measure the color of the light

Hue = Annotated[int, Field(ge=0, le=180)]
Byte = Annotated[int, Field(ge=0, le=255)]
Hsv = tuple[Hue, Byte, Byte]


class DetectorOptions(Parameters):
    """How red is separated from other colors. HSV as in OpenCV: hue 0 to 180, saturation and value 0 to 255."""

    hsv_red_lo1: Tunable[Hsv] = Field((0, 120, 8), description="lower end of the first window: hue, saturation, value")
    hsv_red_hi1: Tunable[Hsv] = Field((10, 255, 255), description="upper end of the first window")
    hsv_red_lo2: Tunable[Hsv] = Field(
        (160, 120, 8), description="lower end of the second window: red goes round the hue axis"
    )
    hsv_red_hi2: Tunable[Hsv] = Field((180, 255, 255), description="upper end of the second window")
    morph_kernel_px: Tunable[int] = Field(7, ge=1, le=51, description="ellipse for opening, then closing [px]")
    min_contour_area_px: Tunable[float] = Field(400.0, gt=0, le=1e7, description="smaller blobs are ignored [px^2]")
    outline_offset_px: Tunable[float] = Field(
        -1.0, ge=-10, le=10, description="where the outline is expected, outside of the silhouette [px]"
    )
    max_offset_px: Tunable[float] = Field(
        1.5, gt=0, le=20, description="an outline that is further from where it is expected is not that of a ball [px]"
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
    """A detected ball.

    Attributes:
        position: (3,) intersection of the ray of its center with the plane of ball centers on the table [m], world.
        pixel: (u, v) of its center [px].
        area: of its blob, divided by the number of balls in it [px^2].
        partial: extends beyond the border of the image.
        outline: (n, 2) its fitted silhouette [px].
    """

    position: tuple[float, float, float]
    pixel: tuple[float, float]
    area: float
    partial: bool
    outline: Array


@dataclass(frozen=True)
class _Seen:
    center: Array  # (3,) relative to the optical center [m]
    area: float  # [px^2]
    border: Array  # (m, 2) pixels of its blob at the border of the image


class Detector:
    """Finds balls; the same image always gives the same detections."""

    def __init__(self, surroundings: Surroundings, options: DetectorOptions | None = None) -> None:
        """Prepare for balls of the surroundings' size.

        Args:
            surroundings: radius of the balls, table, container.
            options: color windows and sizes; they may change between images.
        """
        self.options = options or DetectorOptions()
        self.resting = BallGeometry.of(surroundings)
        self._around = surroundings
        self._table: tuple[Pinhole, BoolMask | None] | None = None  # where the last camera shows it
        self._masks = Masks()
        self._outlines: dict[OutlineKey, Outline] = {}  # of the last image, reused while a blob stays the same
        self._singles, self._floor = SingleFits(self.resting), ContainerFloor(surroundings, self.resting)
        self.blind = ""  # why the last image is unusable
        self.outliers: list[Outlier] = []  # red objects in the last image that are no balls on the table
        self.too_small = 0  # blobs of the last image below the minimum area, outside of the container
        self.too_large = 0  # round blobs of the last image larger than a ball on a stack, outside of the container
        self._last: tuple[Mask, Pinhole, DetectorOptions, list[Detection]] | None = None

    def masks(self, picture: Picture, camera: Pinhole) -> RedMasks:
        """Return what is red in a bgr8 image. The masks must not be written to.

        The color of the light is measured on the table: around it a camera at the side sees a floor of another color.
        """
        o = self.options
        windows = (o.hsv_red_lo1, o.hsv_red_hi1), (o.hsv_red_lo2, o.hsv_red_hi2)
        if self._table is None or self._table[0] is not camera:
            table = shows_table(self._around, camera, sampled_pixels(camera.height, camera.width))
            self._table = camera, table if table.mean() >= _LEAST_TABLE else None
        return self._masks.of(picture, Colours(windows, o.morph_kernel_px), self._table[1])

    def detect(self, picture: Picture, camera: Pinhole) -> list[Detection]:
        """Return the balls in a bgr8 image (height, width, 3), nearest to the upper left corner first.

        An image equal to the last one, as simulated ones without noise often are, is not processed again.
        """
        masks = self.masks(picture, camera)
        last = self._last
        if last and masks.closed is last[0] and camera is last[1] and self.options == last[2]:
            return list(last[3])
        table = None if self._table is None else self._table[1]
        found = [one for one in self._look_at(masks, camera)
                 if not self._floor.is_seen(one.pixel, one.outline, picture, camera, table)]
        self.blind = "" if found else blank_image_reason(picture)
        self._last = (masks.closed, camera, self.options.model_copy(), found)
        return list(found)

    def detect_in_depth(self, picture: Picture, depth: Depth, camera: Pinhole) -> list[Detection]:
        """Return balls with the depth image (height, width) [m]: at their true position, on the table or on others."""
        fine, closed, narrow = self.masks(picture, camera)
        centers = find_balls_in_depth(fine, depth, camera, self.resting.radius)
        found = []
        if len(centers):
            pixels, outlines = camera.project(centers), silhouettes(camera, centers, self.resting.radius, 32)
            inside = np.asarray(camera.in_image(outlines).all(axis=1))
            area = cv2.countNonZero(fine) / len(centers)
            for center, pixel, outline, whole in zip(centers.tolist(), pixels.tolist(), outlines, inside, strict=True):
                place, seen = (center[0], center[1], center[2]), (pixel[0], pixel[1])
                found.append(Detection(place, seen, area, not whole, outline))
        self.outliers = self._on_table(camera, [
            self._outlier(np.array(middle), camera, NOT_ROUND)
            for middle, contour in blob_centers(closed, self.options.min_contour_area_px)
            if not any(cv2.pointPolygonTest(contour, one.pixel, False) >= 0 for one in found)
        ] + self._thin(narrow, camera))
        self.blind, self.too_small, self._last = "" if found else blank_image_reason(picture), 0, None
        return sorted(found, key=lambda d: (d.pixel[1], d.pixel[0]))

    def _look_at(self, masks: RedMasks, camera: Pinhole) -> list[Detection]:
        fine, closed, narrow = masks
        if self._last is None or camera is not self._last[1]:
            self._outlines.clear()
            self._singles.clear()
        blobs = find_blobs(closed, fine, camera, self.options.min_contour_area_px, self._outlines)
        self._outlines = {blob.traced: blob.outline for blob in blobs}
        small = small_blobs(closed, self.options.min_contour_area_px)
        # A ball below others in the container shows little of itself, too.
        self.too_small = sum(not self.resting.shows_container(camera, pixel) for pixel in small)
        # Pixel size for a ball straight below the camera. A ball that lies higher looks larger by a length that hardly
        # grows with the distance, so this size is also the measure for a camera at the side.
        pixel_size = abs(float(camera.position[2]) - self.resting.plane) / camera.fx
        offset = self.options.outline_offset_px * pixel_size
        seen: list[_Seen] = []
        self.outliers, self.too_large = self._thin(narrow, camera), 0
        alone, crowded, offsets = self._alone(blobs, camera, offset, pixel_size)
        seen += alone
        spread = 1.0 * pixel_size
        for blob in crowded:  # balls that touch, occlude each other or cross the border
            if offsets:  # all outlines of an image have the same offset in pixels, measured on single balls
                there = self._pixel_size(camera, blob.centroid)
                offset, spread = float(np.median(offsets)) * there, 0.2 * there
            centers = separate(blob.outline, closed, camera, self.resting, offset)
            if len(centers):
                fit = fit_spheres(blob.outline, centers, self.resting.radius, offset=offset, offset_std=spread)
                if not self._is_explained(blob, fit.owner, camera):
                    self.outliers += [self._outlier(camera.project(center + camera.position), camera, NOT_ROUND)
                                 for center in fit.centers]
                    continue
                reasons = self._higher(blob, fit, camera, fine, offset if offsets else None, pixel_size)
                if reasons:
                    self.outliers += [self._outlier(camera.project(center + camera.position), camera, reason)
                                 for center, reason in zip(fit.centers, reasons, strict=True)]
                    continue
                seen += [_Seen(center, blob.area / len(centers), blob.border) for center in fit.centers]
            elif not len(blob.border):
                self.outliers.append(self._outlier(blob.centroid, camera, NOT_ROUND))
        self.outliers = self._on_table(camera, self.outliers)
        return sorted(self._detections(seen, camera), key=lambda d: (d.pixel[1], d.pixel[0]))

    def _pixel_size(self, camera: Pinhole, pixel: Array) -> float:
        """Size of one pixel on a ball on the table seen at a pixel [m]; for a side camera it grows with distance.

        Above the horizon it is that of a ball straight below.
        """
        center = np.append(camera.on_plane(pixel, self.resting.plane), self.resting.plane)
        depth = float(camera.to_camera(center)[2])
        return (depth if np.isfinite(depth) else abs(float(camera.position[2]) - self.resting.plane)) / camera.fx

    def _alone(
        self, blobs: list[Blob], camera: Pinhole, offset: float, pixel_size: float
    ) -> tuple[list[_Seen], list[Blob], list[float]]:
        """Return blobs that are one complete ball, blobs that are not round, and the offsets of the former [px].

        A round blob larger than any ball can look there is ignored: it is something else, or falling.
        """
        tried, crowded = self._singles.fit(blobs, camera, offset, pixel_size)
        alone: list[_Seen] = []
        offsets: list[float] = []
        sizes: list[float] = []
        for blob, tries in tried:
            if min(one.close for one in tries) < ROUND:
                crowded.append(blob)
                continue
            there = self._pixel_size(camera, blob.centroid)
            best = min(tries, key=lambda one: abs(one.offset - offset))
            if best.offset - offset > FALLING:
                self.too_large += not self.resting.shows_container(camera, blob.centroid)
                continue
            if abs(best.offset - offset) > self.options.max_offset_px * pixel_size:
                self.outliers.append(self._outlier(blob.centroid, camera, sized(best.offset, offset)))
            elif best.oval > MOST_OVAL * there and not self.resting.shows_container(camera, blob.centroid):
                self.outliers.append(self._outlier(blob.centroid, camera, FLAT))
            else:
                alone.append(_Seen(best.center, blob.area, blob.border))
                offsets.append(best.offset / there)
                sizes.append(there)
        usual = float(np.median(offsets)) if offsets else 0.0
        for k in np.flatnonzero(unlike(np.array(offsets), MOST_UNLIKE))[::-1].tolist():
            pixel = camera.project(alone[k].center + camera.position)
            if not self.resting.shows_container(camera, pixel):
                self.outliers.append(self._outlier(pixel, camera, sized(offsets[k] * sizes[k], usual * sizes[k])))
                del alone[k], offsets[k]
        return alone, crowded, offsets

    def _is_explained(self, blob: Blob, owner: npt.NDArray[np.intp], camera: Pinhole) -> bool:
        """Return whether the balls explain the outline of their blob; blobs in the container are exempt."""
        if self.resting.shows_container(camera, blob.centroid):
            return True
        return float(np.mean(owner >= 0)) >= EXPLAINED

    def _higher(
        self, blob: Blob, fit: Fit, camera: Pinhole, fine: Mask, usual: float | None, pixel_size: float
    ) -> list[str]:
        """Return why the balls of a blob must not be taken because one lies on others; empty if none does.

        `usual` is the offset of single balls [m]; without any, that of the ball that looks smallest.
        """
        if len(blob.border) or self.resting.shows_container(camera, blob.centroid):
            return []
        reach = self.resting.radius + max(0.0, fit.offset + BLURRED * pixel_size)
        if covered(fit.centers, reach, fine, camera):
            return [COVERED] * len(fit.centers)
        distance, _ = ray_distances(blob.outline.rays, fit.centers)
        own = [distance[fit.owner == k, k] for k in range(len(fit.centers))]
        offsets = np.array([np.mean(one) - self.resting.radius if len(one) else np.nan for one in own])
        if np.isnan(offsets).all():
            return []
        usual = float(np.nanmin(offsets)) if usual is None else usual
        upper = int(np.nanargmax(offsets))
        if offsets[upper] - usual <= MOST_UNLIKE * pixel_size:
            return []
        return [sized(float(offsets[k]), usual) if k == upper else BELOW for k in range(len(offsets))]

    def _thin(self, narrow: Mask, camera: Pinhole) -> list[Outlier]:
        """Return long, thin red objects."""
        least = LONG * 2 * self.resting.radius
        return [self._outlier(np.array(pixel), camera, THIN)
                for pixel in long_components(narrow, camera, self.resting.table_height, least)]

    def _on_table(self, camera: Pinhole, outliers: list[Outlier]) -> list[Outlier]:
        """Return the outliers outside of the container and below the horizon, where a ray meets the table."""
        return [one for one in outliers
                if np.isfinite(one.position).all() and not self.resting.shows_container(camera, one.pixel)]

    def _outlier(self, pixel: Array, camera: Pinhole, reason: str) -> Outlier:
        return Outlier.at(camera, pixel, self.resting.plane, reason)

    def _detections(self, seen: list[_Seen], camera: Pinhole) -> list[Detection]:
        if not seen:
            return []
        centers = np.array([one.center for one in seen]) + camera.position
        pixels = camera.project(centers)
        places = camera.on_plane(pixels, self.resting.plane)
        outlines = silhouettes(camera, centers, self.resting.radius, 32)
        inside = np.asarray(camera.in_image(outlines).all(axis=1))
        return [
            Detection(
                position=(float(places[k, 0]), float(places[k, 1]), self.resting.plane),
                pixel=(float(pixels[k, 0]), float(pixels[k, 1])),
                area=one.area,
                partial=not inside[k] or self._cut(one, camera),
                outline=outlines[k],
            )
            for k, one in enumerate(seen)
            if np.isfinite(places[k]).all() and np.isfinite(outlines[k]).all()
        ]

    def _cut(self, seen: _Seen, camera: Pinhole) -> bool:
        """Return whether the image border cuts through the ball: its blob touches it there."""
        if not len(seen.border):
            return False
        distance, _ = ray_distances(camera.directions(seen.border), seen.center[None])
        return bool((distance < self.resting.radius).any())


def warm_up(surroundings: Surroundings, options: DetectorOptions) -> None:
    """Process a synthetic image, so that one-time initialization does not delay the first real one."""
    radius, plane = surroundings.ball_radius, BallGeometry.of(surroundings).plane
    camera = Pinhole.from_config(CameraConfig(position=(0, 0, plane + 25 * radius), rpy=(np.pi, 0, 0)))
    picture = np.full((camera.height, camera.width, 3), 128, np.uint8)
    detector = Detector(surroundings, options)
    places = np.array([(0, 0, plane)]) + radius * np.array([(0, 0, 0), (4, 0, 0), (4, 2, 0)])
    for outline in silhouettes(camera, places, radius, 32):
        cv2.fillConvexPoly(picture, np.rint(outline).astype(np.int32), (0, 0, 255))
    detector.detect(picture, camera)


WHOLE, PARTIAL = (0, 255, 0), (0, 200, 255)


def annotate(picture: Picture, detections: Sequence[Detection]) -> Picture:
    """Return a copy of the bgr8 image with outline, center and position [m] of each detection."""
    shown = picture.copy()
    for d in detections:
        color = PARTIAL if d.partial else WHOLE
        points = np.rint(np.clip(d.outline, -4000, 20000) * 16).astype(np.int32)
        cv2.polylines(shown, [points], True, color, 1, cv2.LINE_AA, 4)
        u, v = (round(value) for value in d.pixel)
        cv2.drawMarker(shown, (u, v), color, cv2.MARKER_CROSS, 9, 1)
    draw_labels(shown, [(f"{d.position[0]:.3f} {d.position[1]:+.3f}{' partial' if d.partial else ''}", *d.pixel,
                         float(np.ptp(d.outline[:, 1])) / 2) for d in detections])
    return shown
