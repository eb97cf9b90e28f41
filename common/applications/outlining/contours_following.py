"""Which contour is chosen, from picture to picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from common.applications.outlining.contours_choice import NoSuchContour, choose, described
from common.applications.outlining.messages import Contour, OutlineSelect

LARGEST_CHANGE = 2.0  # of the area of an object between two pictures


class Following:
    """The choice, and the object it fell upon: found again in each picture by its place and size.

    It is looked for as it was last seen, and as it was when it was chosen: what is seen while the arm hides more and
    more of it is a smaller and smaller part.

    A choice that nothing fits yet is tried on every picture. Once it fell upon an object it stays with it: when that
    is not seen (the arm may be before it), nothing is chosen, rather than something else.
    """

    def __init__(self, wanted: OutlineSelect | None) -> None:
        """Begin with a choice, or with none."""
        self._wanted = wanted
        self._chosen: Contour | None = None
        self._last: Contour | None = None

    def select(self, contours: Sequence[Contour], wanted: OutlineSelect) -> Contour:
        """The contour that a new choice falls upon; if there is none, the choice before it stays.

        Raises:
            NoSuchContour: with the choices.
        """
        contour = choose(contours, wanted)
        self._wanted, self._chosen, self._last = wanted, contour, contour
        return contour

    def find(self, contours: Sequence[Contour]) -> tuple[int, str]:
        """Index of the chosen contour in a new picture, or -1 and why there is none."""
        if self._chosen is not None:
            near = min(contours, key=self._distance, default=None)
            if near is None or not math.isfinite(self._distance(near)):
                return -1, f"{self._chosen.label} is not seen any more; choices: {described(contours)}"
            self._last = near
            return near.index, ""
        if self._wanted is None:
            return -1, f"no object is chosen; choices: {described(contours)}"
        try:
            return self.select(contours, self._wanted).index, ""
        except NoSuchContour as error:
            return -1, str(error)

    def _distance(self, contour: Contour) -> float:
        """How far a contour is from the chosen one [px]; infinite when it cannot be the same."""
        return min((distance(contour, known) for known in (self._last, self._chosen) if known), default=math.inf)


def distance(contour: Contour, known: Contour) -> float:
    """How far a contour is from one that is known [px]; infinite when it cannot be the same object."""
    smaller, larger = sorted((contour.area + 1, known.area + 1))
    away = float(np.linalg.norm(np.mean(contour.pixels, axis=0) - np.mean(known.pixels, axis=0)))
    same_kind = (contour.parent < 0) == (known.parent < 0)
    fits = same_kind and larger <= LARGEST_CHANGE * smaller and away <= math.sqrt(larger)
    return away if fits else math.inf
