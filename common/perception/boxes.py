"""Boxes of known colours and sizes in a picture with depth: which kind each is, where it is, and how it is turned.

Depth tells the top face of a box from its walls and from what stands lower: of what has the colour, the highest level
part is a top face. The rectangle about it says where the box is and how it is turned. What is level but as large as no
box of its kind is left out: another thing, or a box that is hidden in part. Boxes that stand side by side like tiles
make one rectangle, which is cut into them.
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
from common.perception.pinhole import Pinhole

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
Bools = npt.NDArray[np.bool_]

HIGH = 95  # percentile of the heights of what has the colour that lies on its highest face
TILES = 4  # boxes in a row that are told apart at most
FILLED = 0.85  # part of its rectangle that a face covers at least


class BoxKind(Section):
    """A kind of box: its colour, and its size along its own axes [m]; it lies with z up."""

    color: Rgb
    size: tuple[Length, Length, Length]


class BoxOptions(Parameters):
    """What is looked for, and how exactly. HSV as OpenCV has it: hue 0 to 180, saturation and value 0 to 255."""

    kinds: dict[str, BoxKind] = Field({}, max_length=20, description="boxes to look for, by what to call them")
    hue_tolerance: Tunable[int] = Field(10, ge=1, le=90, description="a hue this far from that of a kind is of it")
    min_saturation: Tunable[int] = Field(90, ge=0, le=255, description="what is paler has no colour")
    min_value: Tunable[int] = Field(40, ge=0, le=255, description="what is darker has no colour")
    level: Tunable[float] = Field(0.003, gt=0, le=0.05, description="heights that differ by less are one face [m]")
    size_tolerance: Tunable[float] = Field(
        0.006, gt=0, le=0.05, description="a face that is this much longer or shorter is of no such box [m]"
    )


@dataclass(frozen=True, eq=False)
class DetectedBox:
    """A box that was seen: its middle (3,) [m] and its yaw [rad], in world; corners (4, 2) of its top face [px]."""

    kind: str
    position: tuple[float, float, float]
    yaw: float
    corners: Array
    partial: bool  # its colour goes on to the border of the picture


class BoxDetector:
    """Finds boxes: the same picture always gives the same ones."""

    def __init__(self, options: BoxOptions) -> None:
        """Look for the kinds of the options, whose other values may change between pictures."""
        self.options = options
        self._hues = {name: _hue(kind.color) for name, kind in options.kinds.items()}
        self._rays: tuple[Pinhole, Rays] | None = None

    def detect(self, picture: Picture, depth: Depth, camera: Pinhole) -> list[DetectedBox]:
        """Boxes in a bgr8 picture (height, width, 3) with depth (height, width) [m], kind by kind.

        Raises:
            FrameError: the camera is none that there can be.
        """
        if self._rays is None or self._rays[0] is not camera:
            pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
            self._rays = camera, Rays.through(camera, pixels)
        require_in_range(self._rays[1].directions)
        rays, o, measured = self._rays[1], self.options, is_valid(depth)
        below = np.abs(depth * rays.directions[..., 2])  # the camera [m]
        found: list[DetectedBox] = []
        for name, coloured in self._coloured(picture):
            kind = o.kinds[name]
            least = 0.999 * FILLED**2 * kind.size[0] * kind.size[1] * camera.fx**2  # [px^2 m^2], of `_boxes`; rounded
            for left, top, inside in _patches(coloured & measured, below, least):
                height, width = inside.shape
                cut = (slice(top, top + height), slice(left, left + width))
                points = rays.origin + depth[cut][..., None].astype(float) * rays.directions[cut]
                border = left == 0 or top == 0 or left + width == camera.width or top + height == camera.height
                for face in _faces(inside, points[..., 2], o.level):
                    found += self._boxes(name, kind, points[face], camera, border)
        return found

    def mask(self, picture: Picture) -> Picture:
        """(height, width) 255 where a bgr8 picture has the colour of a kind, with depth or without."""
        union = np.zeros(picture.shape[:2], bool)
        for _, coloured in self._coloured(picture):
            union |= coloured
        return np.where(union, 255, 0).astype(np.uint8)

    def _coloured(self, picture: Picture) -> Iterator[tuple[str, Bools]]:
        """Each kind, and (height, width) where the picture has its colour."""
        o = self.options
        hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV).astype(np.int16)
        bright = (hsv[..., 1] >= o.min_saturation) & (hsv[..., 2] >= o.min_value)
        for name in o.kinds:
            away = np.abs(hsv[..., 0] - self._hues[name])
            yield name, bright & (np.minimum(away, 180 - away) <= o.hue_tolerance)

    def _boxes(self, name: str, kind: BoxKind, face: Array, camera: Pinhole, border: bool) -> Iterator[DetectedBox]:
        """The boxes with that top face (n, 3) [m]."""
        top = float(np.median(face[:, 2]))
        pixel = (float(camera.position[2]) - top) / camera.fx  # [m]
        if len(face) * pixel**2 < FILLED**2 * kind.size[0] * kind.size[1]:
            return
        origin = face[:, :2].mean(axis=0)  # single precision is enough near it
        corners = cv2.boxPoints(cv2.minAreaRect((face[:, :2] - origin).astype(np.float32))).astype(float)
        sides = corners[1] - corners[0], corners[3] - corners[0]
        lengths = [float(np.hypot(*side)) + pixel for side in sides]  # from edge to edge, not from middle to middle
        if len(face) * pixel**2 < FILLED * lengths[0] * lengths[1]:
            return
        middle = corners.mean(axis=0) + origin
        for first in (0, 1):
            counts = self._tiles(lengths[first], kind.size[0]), self._tiles(lengths[1 - first], kind.size[1])
            if not all(counts):
                continue
            along = sides[first] / np.hypot(*sides[first])
            across = np.array([-along[1], along[0]])
            yaw = math.remainder(math.atan2(along[1], along[0]), math.pi)  # half a turn later it looks the same
            for i in range(counts[0]):
                for k in range(counts[1]):
                    at = middle + (i - (counts[0] - 1) / 2) * kind.size[0] * along \
                        + (k - (counts[1] - 1) / 2) * kind.size[1] * across
                    rim = [[*(at + a * kind.size[0] / 2 * along + b * kind.size[1] / 2 * across), top]
                           for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
                    place = float(at[0]), float(at[1]), top - kind.size[2] / 2
                    yield DetectedBox(name, place, yaw, camera.project(rim), border)
            return

    def _tiles(self, length: float, size: float) -> int:
        """How many boxes of a size make up a length [m]; 0 when none do."""
        count = round(length / size)
        return count if count <= TILES and abs(length - count * size) <= self.options.size_tolerance else 0


def draw_boxes(picture: Picture, boxes: list[DetectedBox]) -> Picture:
    """A copy of the bgr8 picture with the top face, the kind and the place [m] of each box."""
    shown = picture.copy()
    for box in boxes:
        cv2.polylines(shown, [np.rint(box.corners * 16).astype(np.int32)], True, (255, 255, 255), 1, cv2.LINE_AA, 4)
        u, v = box.corners.mean(axis=0)
        label = f"{box.kind} {box.position[0]:.3f} {box.position[1]:+.3f} {math.degrees(box.yaw):.0f} deg"
        cv2.putText(shown, label, (round(u) - 50, round(v) - 22), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 0, 0), 1,
                    cv2.LINE_AA)
    return shown


def _hue(color: Rgb) -> int:
    bgr = np.array([[[round(255 * value) for value in color[::-1]]]], np.uint8)
    return int(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV)[0, 0, 0])


def _patches(mask: Bools, below: Array | None = None, least: float = 0.0) -> Iterator[tuple[int, int, Bools]]:
    """Connected parts of a mask: the left and top of each [px], and the part itself.

    Left out are those too small to be anything: in a picture full of noise there are very many. Their area [px] by the
    square of how far below the camera they are at most, as (height, width) [m] says, is less than the `least`.
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
    """Connected level parts of a patch, the highest first."""
    left = inside.copy()
    while left.any():
        top = float(np.percentile(heights[left], HIGH))
        face = left & (np.abs(heights - top) <= level)
        yield from (_whole(face.shape, *patch) for patch in _patches(face))
        left &= heights < top - level


def _whole(shape: tuple[int, ...], left: int, top: int, part: Bools) -> Bools:
    mask = np.zeros(shape, bool)
    mask[top : top + part.shape[0], left : left + part.shape[1]] = part
    return mask
