"""Detect boxes of known colors and sizes in an RGB-D image: kind, position and yaw of each.

Depth separates the top face of a box from its walls and from lower objects: of the pixels of one color, the highest
level region is a top face. Its minimum-area rectangle gives position and yaw. A level region that matches no size of
its kind is dropped: another object, or a partly occluded box. Boxes side by side form one rectangle, which is divided.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from common.config import Parameters, Section, Tunable
from common.config.basics import Length, Rgb
from common.perception.camera_input import require_in_range
from common.perception.depth import Depth, Rays, is_valid
from common.perception.labels import draw_labels
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

TOP_PERCENTILE = 95  # of the heights of one color: the height of its highest face
MAX_TILES = 4  # boxes in a row that are separated at most
MIN_FILL = 0.85  # fraction of its rectangle that a face must cover


class BoxKind(Section):
    """Color of a kind of box and its size along its own axes [m]; it lies with z up."""

    color: Rgb
    size: tuple[Length, Length, Length]
    round: bool = Field(False, description="the top face is a disk: a cylinder, which is treated as the box around it")

    @property
    def fill(self) -> float:
        """Fraction of its rectangle that the top face must cover."""
        return MIN_FILL * (math.pi / 4 if self.round else 1.0)


class BoxOptions(Parameters):
    """Boxes to detect and tolerances. HSV as in OpenCV: hue 0 to 180, saturation and value 0 to 255."""

    kinds: dict[str, BoxKind] = Field({}, max_length=20, description="boxes to detect, by name")
    hue_tolerance: Tunable[int] = Field(10, ge=1, le=90, description="largest difference from the hue of a kind")
    min_saturation: Tunable[int] = Field(90, ge=0, le=255, description="smallest saturation of a colored pixel")
    min_value: Tunable[int] = Field(40, ge=0, le=255, description="smallest value of a colored pixel")
    level: Tunable[float] = Field(0.003, gt=0, le=0.05, description="height tolerance within one face [m]")
    size_tolerance: Tunable[float] = Field(
        0.006, gt=0, le=0.05, description="tolerance of the side lengths of a top face [m]"
    )


@dataclass(frozen=True, eq=False)
class DetectedBox:
    """A detected box: center (3,) [m] and yaw [rad] in world; corners (4, 2) of its top face [px]."""

    kind: str
    position: tuple[float, float, float]
    yaw: float
    corners: Array
    partial: bool  # its color reaches the border of the image


class BoxDetector:
    """Detects boxes; deterministic for the same image."""

    def __init__(self, options: BoxOptions) -> None:
        """Detect the kinds in the options; all other options may change between images."""
        self.options = options
        self._hues = {name: _hue(kind.color) for name, kind in options.kinds.items()}
        self._rays: tuple[Pinhole, Rays] | None = None

    def detect(self, image: Pixels, depth: Depth, camera: Pinhole) -> list[DetectedBox]:
        """Detect boxes in a bgr8 image (height, width, 3) with depth (height, width) [m], ordered by kind.

        Raises:
            FrameError: the camera model is invalid.
        """
        if self._rays is None or self._rays[0] is not camera:
            pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
            self._rays = camera, Rays.through(camera, pixels)
        require_in_range(self._rays[1].directions)
        rays, o, measured = self._rays[1], self.options, is_valid(depth)
        below = np.abs(depth * rays.directions[..., 2])  # the camera [m]
        found: list[DetectedBox] = []
        for name, color_mask in self._color_masks(image):
            kind = o.kinds[name]
            least = 0.999 * MIN_FILL**2 * kind.size[0] * kind.size[1] * camera.fx**2  # [px^2 m^2], as in `_boxes`
            for left, top, inside in _patches(color_mask & measured, below, least):
                height, width = inside.shape
                cut = (slice(top, top + height), slice(left, left + width))
                points = rays.origin + depth[cut][..., None].astype(float) * rays.directions[cut]
                border = left == 0 or top == 0 or left + width == camera.width or top + height == camera.height
                for face in _faces(inside, points[..., 2], o.level):
                    found += self._boxes(name, kind, points[face], camera, border)
        return found

    def mask(self, image: Pixels) -> Pixels:
        """Mask (height, width): 255 where a bgr8 image has the color of a kind, regardless of depth."""
        union = np.zeros(image.shape[:2], bool)
        for _, color_mask in self._color_masks(image):
            union |= color_mask
        return np.where(union, 255, 0).astype(np.uint8)

    def _color_masks(self, image: Pixels) -> Iterator[tuple[str, Bools]]:
        """Yield each kind with its color mask (height, width)."""
        o = self.options
        hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV).astype(np.int16)
        bright = (hsv[..., 1] >= o.min_saturation) & (hsv[..., 2] >= o.min_value)
        for name in o.kinds:
            away = np.abs(hsv[..., 0] - self._hues[name])
            yield name, bright & (np.minimum(away, 180 - away) <= o.hue_tolerance)

    def _boxes(self, name: str, kind: BoxKind, face: Array, camera: Pinhole, border: bool) -> Iterator[DetectedBox]:
        """Yield the boxes whose top face has these points (n, 3) [m]."""
        top = float(np.median(face[:, 2]))
        pixel = (float(camera.position[2]) - top) / camera.fx  # [m]
        if len(face) * pixel**2 < MIN_FILL * kind.fill * kind.size[0] * kind.size[1]:
            return
        origin = face[:, :2].mean(axis=0)  # float32 is precise enough near it
        corners = cv2.boxPoints(cv2.minAreaRect((face[:, :2] - origin).astype(np.float32))).astype(float)
        sides = corners[1] - corners[0], corners[3] - corners[0]
        lengths = [float(np.hypot(*side)) + pixel for side in sides]  # between outer edges, not between pixel centers
        if len(face) * pixel**2 < kind.fill * lengths[0] * lengths[1]:
            return
        center = corners.mean(axis=0) + origin
        for first in (0, 1):
            counts = self._tiles(lengths[first], kind.size[0]), self._tiles(lengths[1 - first], kind.size[1])
            if not all(counts):
                continue
            along = sides[first] / np.hypot(*sides[first])
            across = np.array([-along[1], along[0]])
            yaw = math.remainder(math.atan2(along[1], along[0]), math.pi)  # symmetric under half a turn
            for i in range(counts[0]):
                for k in range(counts[1]):
                    at = center + (i - (counts[0] - 1) / 2) * kind.size[0] * along \
                        + (k - (counts[1] - 1) / 2) * kind.size[1] * across
                    rim = [[*(at + a * kind.size[0] / 2 * along + b * kind.size[1] / 2 * across), top]
                           for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
                    position = float(at[0]), float(at[1]), top - kind.size[2] / 2
                    yield DetectedBox(name, position, yaw, camera.project(rim), border)
            return

    def _tiles(self, length: float, size: float) -> int:
        """Number of boxes of a size that add up to a length [m]; 0 if none do."""
        count = round(length / size)
        return count if count <= MAX_TILES and abs(length - count * size) <= self.options.size_tolerance else 0


def draw_boxes(image: Pixels, boxes: list[DetectedBox]) -> Pixels:
    """Copy of the bgr8 image with the top face, kind and position [m] of each box."""
    shown = image.copy()
    for box in boxes:
        cv2.polylines(shown, [np.rint(box.corners * 16).astype(np.int32)], True, (255, 255, 255), 1, cv2.LINE_AA, 4)
    draw_labels(shown, [
        (f"{box.kind} {box.position[0]:.3f} {box.position[1]:+.3f} {math.degrees(box.yaw):.0f} deg",
         *box.corners.mean(axis=0), float(np.ptp(box.corners[:, 1])) / 2) for box in boxes])
    return shown


def _hue(color: Rgb) -> int:
    bgr = np.array([[[round(255 * value) for value in color[::-1]]]], np.uint8)
    return int(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)[0, 0, 0])


def _patches(mask: Bools, below: Array | None = None, least: float = 0.0) -> Iterator[tuple[int, int, Bools]]:
    """Yield the connected components of a mask: left, top [px] and the cropped component.

    Components too small to be a box are skipped, since a noisy image has very many of them: those whose area [px] times
    the square of the largest distance `below` the camera (height, width) [m] is less than `least`.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    numbers = np.arange(1, count)
    if below is not None:
        farthest = np.zeros(count)
        np.maximum.at(farthest, labels[mask].astype(np.intp), below[mask])
        numbers = numbers[stats[1:, cv2.CC_STAT_AREA] * farthest[1:] ** 2 >= least]
    for number in numbers.tolist():
        left, top, width, height, _area = (int(value) for value in stats[number])
        yield left, top, labels[top : top + height, left : left + width] == number


def _faces(inside: Bools, heights: Array, level: float) -> Iterator[Bools]:
    """Yield the connected level parts of a patch, highest first."""
    left = inside.copy()
    while left.any():
        top = float(np.percentile(heights[left], TOP_PERCENTILE))
        face = left & (np.abs(heights - top) <= level)
        yield from (_full_mask(face.shape, *patch) for patch in _patches(face))
        left &= heights < top - level


def _full_mask(shape: tuple[int, ...], left: int, top: int, part: Bools) -> Bools:
    mask = np.zeros(shape, bool)
    mask[top : top + part.shape[0], left : left + part.shape[1]] = part
    return mask
