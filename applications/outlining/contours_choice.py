"""Which contour is meant: by a rule, by a colour or by its number."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence

from applications.outlining.contours import is_hole
from applications.outlining.messages import Contour, OutlineSelect
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
