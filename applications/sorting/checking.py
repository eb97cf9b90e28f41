"""What the gripper took: by the width of the fingers, and by what is missing in the picture after the lift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from applications.sorting.topics import SeenObject

Held = Literal["", "one", "empty", "two", "slipped"]

CLOSED = 0.003  # [m] fingers this close hold nothing
SAME = 0.025  # [m] an object that moved farther is another one
GONE = 0.6  # share of its volume that an object has lost if it was taken
MORE = 1.6  # times the expected volume: that is two objects
LEAST_VOLUME = 5e-6  # [m^3] less is noise
BESIDE = 0.12  # [m] from the grasp: what disappears farther away was not taken by it


@dataclass(frozen=True)
class Check:
    """What is held, and by which observation."""

    held: Held
    why: str = ""


def by_width(width: float, holding: bool) -> Check:
    """Return what is held by the width between closed fingers [m]; "" if only a picture can tell."""
    if not holding:
        return Check("empty", "the fingers closed on nothing")
    if width < CLOSED:
        return Check("empty", f"the fingers are {1e3 * width:.1f} mm apart")
    return Check("")


def width_remark(width: float, expected: float, tolerance: float) -> str:
    """Return how the measured width differs from the expected one [m]; empty within the tolerance."""
    off = width - expected
    if abs(off) <= tolerance:
        return ""
    return f"{1e3 * width:.0f} mm wide, not {1e3 * expected:.0f} mm"


def by_picture(
    taken: SeenObject, place: tuple[float, float], before: Sequence[SeenObject], after: Sequence[SeenObject],
) -> Check:
    """Return what is held by comparing the tray before and after the lift.

    Objects that touch may be seen as one before and as several afterwards, so volumes count, not numbers.

    Args:
        taken: the object that the grasp was for.
        place: (x, y) of the grasp in world [m].
        before: objects in the tray before the grasp.
        after: objects in the tray, seen while the arm hides nothing of it.
    """
    lost = {thing.id: _lost(thing, after) for thing in before}
    near = [thing for thing in before if thing.id != taken.id and _distance(thing, place) < BESIDE]
    others = [thing for thing in near if lost[thing.id] >= max(GONE * thing.volume, LEAST_VOLUME)
              and not _moved(thing, before, after)]
    own = lost.get(taken.id, 0.0)
    if others and own >= GONE * taken.volume:
        return Check("two", f"{taken.id} and {', '.join(thing.id for thing in others)} are missing in the tray")
    total = sum(thing.volume for thing in before) - sum(thing.volume for thing in after)
    if others and total > MORE * max(taken.volume, LEAST_VOLUME):
        return Check("two", f"{1e6 * total:.0f} cm^3 are missing in the tray, not {1e6 * taken.volume:.0f}")
    if own < (1 - GONE) * taken.volume and total < (1 - GONE) * taken.volume:
        return Check("one", "nothing is missing in the tray")
    return Check("one")


def _distance(thing: SeenObject, place: tuple[float, float]) -> float:
    return math.dist((thing.center.x, thing.center.y), place)


def _lost(thing: SeenObject, after: Sequence[SeenObject]) -> float:
    """Volume at the place of an object that is there no more [m^3]."""
    reach = max(thing.size.x, thing.size.y) / 2 + SAME
    still = sum(other.volume for other in after if _distance(other, (thing.center.x, thing.center.y)) < reach)
    return max(0.0, thing.volume - still)


def _moved(thing: SeenObject, before: Sequence[SeenObject], after: Sequence[SeenObject]) -> bool:
    """Return whether an object that was not there before looks like this one: it was only pushed."""
    new = [other for other in after
           if all(_distance(other, (known.center.x, known.center.y)) > SAME for known in before)]
    return any(0.5 * thing.volume < other.volume < 2.0 * thing.volume for other in new)
