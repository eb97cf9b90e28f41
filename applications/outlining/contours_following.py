"""Which contour is chosen, from picture to picture."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence

import cv2
import numpy as np

from applications.outlining.contours import is_hole
from applications.outlining.contours_choice import NoSuchContour, choose, described
from applications.outlining.messages import Contour, OutlineSelect
from common.messages import Color

LARGEST_CHANGE = 2.0  # of the area of an object between two pictures
PART = 0.9  # of the edge of a part that lies within the whole
SAMPLED = 500  # points of that edge are looked at, at least
NEAR = 3.0  # [px] without or within
LARGEST_TURN = 1 / 6  # of the circle of hues, by which an object may look another: from red to yellow
COLOURFUL = 0.25  # saturation from which on a hue says something


class Following:
    """The choice, and the object it fell upon: found again in each picture by its place and size.

    It is looked for as it was last seen, and as it was when it was chosen: what is seen while the arm hides more and
    more of it is a smaller and smaller part.

    A choice that nothing fits yet is tried on every picture. Once it fell upon an object it stays with it: when that
    is not seen (the arm may be before it), nothing is chosen, rather than something else. What was chosen by itself in
    the first picture may have been a part of an object, with the arm before the rest: then it falls upon the whole.
    What goes on outside of the picture is not chosen instead: its outline would be a part of it.
    """

    def __init__(self, wanted: OutlineSelect | None) -> None:
        """Begin with a choice, or with none."""
        self._wanted = wanted
        self._chosen: Contour | None = None
        self._last: Contour | None = None
        self._hole = False  # whether it is the edge of one
        self._by_itself = True

    def select(self, contours: Sequence[Contour], wanted: OutlineSelect) -> Contour:
        """The contour that a new choice falls upon; if there is none, the choice before it stays.

        Raises:
            NoSuchContour: with the choices.
        """
        contour = choose(contours, wanted)
        self._wanted, self._by_itself = wanted, False
        self._fall_upon(contours, contour)
        return contour

    def find(self, contours: Sequence[Contour]) -> tuple[int, str]:
        """Index of the chosen contour in a new picture, or -1 and why there is none."""
        if self._chosen is not None:
            border = self._chosen.touches_border
            seen = [contour for contour in contours
                    if is_hole(contours, contour.index) == self._hole and (border or not contour.touches_border)]
            near = min(seen, key=self._distance, default=None)
            if self._by_itself and (near is None or not math.isfinite(self._distance(near))):
                near = self._whole(seen)
                self._chosen = near or self._chosen
            if near is None or not math.isfinite(self._distance(near)):
                return -1, f"{self._chosen.label} is not seen any more; choices: {described(contours)}"
            self._last = near
            return near.index, ""
        if self._wanted is None:
            return -1, f"no object is chosen; choices: {described(contours)}"
        try:
            contour = choose(contours, self._wanted)
        except NoSuchContour as error:
            return -1, str(error)
        self._fall_upon(contours, contour)
        return contour.index, ""

    def _fall_upon(self, contours: Sequence[Contour], contour: Contour) -> None:
        self._chosen = self._last = contour
        self._hole = is_hole(contours, contour.index)

    def _distance(self, contour: Contour) -> float:
        """How far a contour is from the chosen one [px]; infinite when it cannot be the same."""
        return min((distance(contour, known) for known in (self._last, self._chosen) if known), default=math.inf)

    def _whole(self, contours: Sequence[Contour]) -> Contour | None:
        """The only contour that has in it what was chosen, as far as it was seen; else None."""
        assert self._chosen is not None
        edge = self._chosen.pixels
        found = [contour for contour in contours if _same_kind(contour, self._chosen)
                 and contour.area > self._chosen.area and _share_within(edge, contour) >= PART]
        return found[0] if len(found) == 1 else None


def _share_within(edge: Sequence[tuple[float, float]], contour: Contour) -> float:
    around = np.array(contour.pixels, np.float32)
    some = edge[::max(1, len(edge) // SAMPLED)]  # each costs time in proportion to the points of the contour
    return float(np.mean([cv2.pointPolygonTest(around, at, measureDist=True) > -NEAR for at in some]))


def _same_kind(contour: Contour, known: Contour) -> bool:
    """Whether both are outer edges or both lie within another, and what they hold may have one colour."""
    return (contour.parent < 0) == (known.parent < 0) and _hues_apart(contour.color, known.color) <= LARGEST_TURN


def _hues_apart(a: Color, b: Color) -> float:
    """How far two colours are from each other around the circle of hues, 0 to 0.5; 0 for what is grey."""
    (hue_a, saturation_a, _), (hue_b, saturation_b, _) = (colorsys.rgb_to_hsv(c.r, c.g, c.b) for c in (a, b))
    turn = abs(hue_a - hue_b)
    return min(turn, 1 - turn) if min(saturation_a, saturation_b) >= COLOURFUL else 0.0


def distance(contour: Contour, known: Contour) -> float:
    """How far a contour is from one that is known [px]; infinite when it cannot be the same object."""
    smaller, larger = sorted((contour.area + 1, known.area + 1))
    away = float(np.linalg.norm(np.mean(contour.pixels, axis=0) - np.mean(known.pixels, axis=0)))
    fits = _same_kind(contour, known) and larger <= LARGEST_CHANGE * smaller and away <= math.sqrt(larger)
    return away if fits else math.inf
