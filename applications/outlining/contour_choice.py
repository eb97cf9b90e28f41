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

HUES = {"red": 0, "orange": 30, "yellow": 60, "green": 120, "cyan": 180, "blue": 240, "magenta": 300}  # [degrees]
SAME_MIDDLE = 3.0  # [px] contours whose middles are this near lie in one another
NAMES = [*HUES, "white", "grey", "black"]


class NoSuchContour(ZencellError):
    """Nothing in the picture fits the request. `code` is for programs: empty, border, colour, index or rule."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def colour_name(color: Color) -> str:
    """The nearest of `NAMES`."""
    hue, saturation, value = colorsys.rgb_to_hsv(color.r, color.g, color.b)
    if value < 0.2:
        return "black"
    if saturation < 0.25:
        return "white" if value > 0.85 else "grey"
    return min(HUES, key=lambda name: abs((hue * 360 - HUES[name] + 180) % 360 - 180))


def described(contours: Sequence[Contour], some: Sequence[Contour] | None = None) -> str:
    """The contours, or some of them, one after the other: number, label, colour and what is special."""
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
    """The request that a word stands for: auto, a colour, an index, a label such as Object_2; None for none.

    Raises:
        NoSuchContour: it is none of those.
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
    """The contour that a request means.

    auto: the largest object that does not touch the border of the picture; colour: the largest such of that colour;
    index: exactly that one, whatever it is; where it is told where that was seen, the one that is there.

    Raises:
        NoSuchContour: with the choices.
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
    """The mean of its pixels."""
    us, vs = zip(*contour.pixels, strict=True)
    return sum(us) / len(us), sum(vs) / len(vs)


def _seen_at(contours: Sequence[Contour], index: int, at: tuple[float, float]) -> Contour:
    """The contour with its middle at a pixel; of several that have one middle the one with that index.

    Raises:
        NoSuchContour: there is none.
    """
    away = {contour.index: math.dist(middle_of(contour), at) for contour in contours}
    near = [each for each in contours if away[each.index] ** 2 <= each.area + 1
            and away[each.index] <= min(away.values()) + SAME_MIDDLE]
    if not near:
        raise NoSuchContour("index", f"contour {index} is not where it was seen; choices: {described(contours)}")
    return min(near, key=lambda each: (each.index != index, away[each.index]))


LARGEST_CHANGE = 2.0  # of the area of an object between two pictures
PART = 0.9  # of the edge of a part that lies within the whole
SAMPLED = 500  # points of that edge are looked at, at least
NEAR = 3.0  # [px] without or within
LARGEST_TURN = 1 / 6  # of the circle of hues, by which an object may look another: from red to yellow
COLOURFUL = 0.25  # saturation from which on a hue says something


class ContourTracker:
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


Picture = npt.NDArray[np.uint8]

OBJECT, HOLE, BORDER, CHOSEN = (0, 140, 255), (255, 160, 0), (128, 128, 128), (255, 0, 255)  # bgr


def annotate_contours(picture: Picture, contours: Sequence[Contour], selected: int = -1) -> Picture:
    """A copy of the bgr8 picture with all contours and their labels; the selected one stands out."""
    shown = picture.copy()
    for contour in contours:
        color = HOLE if is_hole(contours, contour.index) else BORDER if contour.touches_border else OBJECT
        if contour.index == selected:
            color = CHOSEN
        points = np.array(contour.pixels)
        fixed = np.rint(points * 16).astype(np.int32)
        cv2.polylines(shown, [fixed], True, color, 3 if contour.index == selected else 2, cv2.LINE_AA, 4)
        _label(shown, contour.label, points, color)
    return shown


def _label(shown: Picture, text: str, points: npt.NDArray[np.float64], color: tuple[int, int, int]) -> None:
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.6
    (width, height), _ = cv2.getTextSize(text, font, scale, 1)
    u, v = points.mean(axis=0)
    x = round(min(max(u - width / 2, 2), shown.shape[1] - width - 2))
    y = round(min(max(v + height / 2, height + 2), shown.shape[0] - 4))
    cv2.putText(shown, text, (x, y), font, scale, (0, 0, 0), 4, cv2.LINE_AA)
    cv2.putText(shown, text, (x, y), font, scale, color, 1, cv2.LINE_AA)
