"""Choose a contour, follow it from image to image, and draw all contours."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from applications.outlining.contours import is_hole
from applications.outlining.topics import Contour, OutlineSelect
from common.errors import ZencellError
from common.messages import Color
from common.perception.labels import draw_labels

HUES = {"red": 0, "orange": 30, "yellow": 60, "green": 120, "cyan": 180, "blue": 240, "magenta": 300}  # [degrees]
SAME_MIDDLE = 3.0  # [px] contours whose centers are this close are nested
NAMES = [*HUES, "white", "grey", "black"]


class NoSuchContour(ZencellError):
    """No contour in the image fits the request. `code` is for programs: empty, border, colour, index or rule."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def colour_name(color: Color) -> str:
    """Return the nearest of `NAMES`."""
    hue, saturation, value = colorsys.rgb_to_hsv(color.r, color.g, color.b)
    if value < 0.2:
        return "black"
    if saturation < 0.25:
        return "white" if value > 0.85 else "grey"
    return min(HUES, key=lambda name: abs((hue * 360 - HUES[name] + 180) % 360 - 180))


def described(contours: Sequence[Contour], some: Sequence[Contour] | None = None) -> str:
    """List contours with index, label, color and special properties."""
    shown = contours if some is None else some
    if not shown:
        return "none"
    parts = []
    for contour in shown:
        notes = [colour_name(contour.color)]
        if is_hole(contours, contour.index):
            notes = [f"hole in Object_{contour.parent}"]
        if contour.touches_border:
            notes.append("touches the border")
        parts.append(f"{contour.index} ({contour.label}, {', '.join(notes)})")
    return "; ".join(parts)


def parse_choice(text: str | int) -> OutlineSelect | None:
    """Convert auto, a color, an index or a label such as Object_2 to a request; none to None.

    Raises:
        NoSuchContour: the text is none of those.
    """
    word = str(text).strip()
    if word in ("", "none"):
        return None
    if word == "auto":
        return OutlineSelect()
    number = word.removeprefix("Object_")
    if number.isdecimal():
        return OutlineSelect(rule="index", index=int(number))
    if word.lower().replace("gray", "grey") in NAMES:
        return OutlineSelect(rule="colour", colour=word.lower())
    raise NoSuchContour("rule", f"{word!r} is no choice; choices: none, auto, an index, {', '.join(NAMES)}")


def choose(contours: Sequence[Contour], wanted: OutlineSelect) -> Contour:
    """Return the contour that a request selects.

    auto: the largest object that does not touch the image border; colour: the largest such object of that color; index:
    exactly that one, or the one at the position `at` where it was seen.

    Raises:
        NoSuchContour: there is none; lists the choices.
    """
    if wanted.rule == "index":
        if wanted.index is None:
            raise NoSuchContour("index", f"no index is given; choices: {described(contours)}")
        if wanted.at is not None:
            return _seen_at(contours, wanted.index, wanted.at)
        if wanted.index >= len(contours):
            raise NoSuchContour("index", f"there is no contour {wanted.index}; choices: {described(contours)}")
        return contours[wanted.index]
    objects = [c for c in contours if not is_hole(contours, c.index)]
    if not objects:
        raise NoSuchContour("empty", "the picture has no contour")
    colour = wanted.colour.strip().lower().replace("gray", "grey")
    if wanted.rule == "colour":
        if colour not in NAMES:
            raise NoSuchContour("colour", f"{wanted.colour!r} is no colour; choices: {', '.join(NAMES)}")
        objects = [c for c in objects if colour_name(c.color) == colour]
        if not objects:
            raise NoSuchContour("colour", f"there is no {colour} contour; choices: {described(contours)}")
    whole = [c for c in objects if not c.touches_border]
    if not whole:
        which = f"every {colour}" if wanted.rule == "colour" else "every"
        choices = described(contours, objects)
        raise NoSuchContour("border", f"{which} contour touches the border of the picture: {choices}")
    return max(whole, key=lambda contour: contour.area)


def middle_of(contour: Contour) -> tuple[float, float]:
    """Return the mean of its pixels."""
    us, vs = zip(*contour.pixels, strict=True)
    return sum(us) / len(us), sum(vs) / len(vs)


def _seen_at(contours: Sequence[Contour], index: int, at: tuple[float, float]) -> Contour:
    """Return the contour with its center at a pixel; of nested ones the one with that index.

    Raises:
        NoSuchContour: there is none.
    """
    away = {contour.index: math.dist(middle_of(contour), at) for contour in contours}
    near = [each for each in contours if away[each.index] ** 2 <= each.area + 1
            and away[each.index] <= min(away.values()) + SAME_MIDDLE]
    if not near:
        raise NoSuchContour("index", f"contour {index} is not where it was seen; choices: {described(contours)}")
    return min(near, key=lambda each: (each.index != index, away[each.index]))


LARGEST_CHANGE = 2.0  # factor of an object's area between two images
PART = 0.9  # fraction of a part's edge that must lie within the complete object
SAMPLED = 500  # smallest number of points of that edge to test
NEAR = 3.0  # [px] tolerance
LARGEST_TURN = 1 / 6  # of the hue circle, by which an object's hue may change: red to yellow
COLOURFUL = 0.25  # saturation from which the hue is meaningful


class ContourTracker:
    """The selected object, found again in each image by its position and size.

    It is compared with its last contour and with the one at its selection: while the arm occludes more and more of it,
    the visible part shrinks.

    A selection without a match is tried on every image. Once it has matched an object it stays with it: while that
    object is not visible (the arm may occlude it), nothing is selected. An automatic selection in the first image may
    have matched a part of an object, with the arm in front of the rest; it then switches to the complete object. An
    object cut off by the image border is not selected instead: its outline would be incomplete.
    """

    def __init__(self, wanted: OutlineSelect | None) -> None:
        """Start with a selection, or with none."""
        self._wanted = wanted
        self._chosen: Contour | None = None
        self._last: Contour | None = None
        self._hole = False  # whether it is the edge of a hole
        self._by_itself = True

    def select(self, contours: Sequence[Contour], wanted: OutlineSelect) -> Contour:
        """Return the contour that a new selection matches; without a match the previous selection stays.

        Raises:
            NoSuchContour: nothing matches; lists the choices.
        """
        contour = choose(contours, wanted)
        self._wanted, self._by_itself = wanted, False
        self._fall_upon(contours, contour)
        return contour

    def find(self, contours: Sequence[Contour]) -> tuple[int, str]:
        """Return the index of the selected contour in a new image, or -1 and the reason."""
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
        """Return the distance of a contour from the selected one [px]; infinite if it cannot be the same object."""
        return min((distance(contour, known) for known in (self._last, self._chosen) if known), default=math.inf)

    def _whole(self, contours: Sequence[Contour]) -> Contour | None:
        """Return the only contour that contains the selected one, as far as it was visible; else None."""
        assert self._chosen is not None
        edge = self._chosen.pixels
        found = [contour for contour in contours if _same_kind(contour, self._chosen)
                 and contour.area > self._chosen.area and _share_within(edge, contour) >= PART]
        return found[0] if len(found) == 1 else None


def _share_within(edge: Sequence[tuple[float, float]], contour: Contour) -> float:
    around = np.array(contour.pixels, np.float32)
    some = edge[::max(1, len(edge) // SAMPLED)]  # the cost of each test is proportional to the contour's points
    return float(np.mean([cv2.pointPolygonTest(around, at, measureDist=True) > -NEAR for at in some]))


def _same_kind(contour: Contour, known: Contour) -> bool:
    """Return whether both are outer edges or both are nested, and their colors may be the same."""
    return (contour.parent < 0) == (known.parent < 0) and _hues_apart(contour.color, known.color) <= LARGEST_TURN


def _hues_apart(a: Color, b: Color) -> float:
    """Return the distance of two colors on the hue circle, 0 to 0.5; 0 for gray."""
    (hue_a, saturation_a, _), (hue_b, saturation_b, _) = (colorsys.rgb_to_hsv(c.r, c.g, c.b) for c in (a, b))
    turn = abs(hue_a - hue_b)
    return min(turn, 1 - turn) if min(saturation_a, saturation_b) >= COLOURFUL else 0.0


def distance(contour: Contour, known: Contour) -> float:
    """Return the distance of two contours [px]; infinite if they cannot belong to the same object."""
    smaller, larger = sorted((contour.area + 1, known.area + 1))
    away = float(np.linalg.norm(np.mean(contour.pixels, axis=0) - np.mean(known.pixels, axis=0)))
    fits = _same_kind(contour, known) and larger <= LARGEST_CHANGE * smaller and away <= math.sqrt(larger)
    return away if fits else math.inf


Picture = npt.NDArray[np.uint8]

OBJECT, HOLE, BORDER, CHOSEN = (0, 140, 255), (255, 160, 0), (128, 128, 128), (255, 0, 255)  # BGR


def annotate_contours(picture: Picture, contours: Sequence[Contour], selected: int = -1) -> Picture:
    """Return a copy of the bgr8 image with all contours and labels; the selected one is highlighted."""
    shown = picture.copy()
    for contour in contours:
        color = HOLE if is_hole(contours, contour.index) else BORDER if contour.touches_border else OBJECT
        if contour.index == selected:
            color = CHOSEN
        points = np.array(contour.pixels)
        fixed = np.rint(points * 16).astype(np.int32)
        cv2.polylines(shown, [fixed], True, color, 3 if contour.index == selected else 2, cv2.LINE_AA, 4)
    outlines = [(contour.label, np.array(contour.pixels)) for contour in contours]
    draw_labels(shown, [(label, *at.mean(axis=0), float(np.ptp(at[:, 1])) / 2) for label, at in outlines])
    return shown
