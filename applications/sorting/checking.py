"""What the gripper took: by the width of the fingers, and by what is missing in the picture after the lift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from applications.sorting.contents import gap
from applications.sorting.topics import SeenObject

Held = Literal["", "one", "empty", "two", "slipped"]

CLOSED = 0.003  # [m] fingers this close hold nothing
SAME = 0.025  # [m] an object that moved farther is another one
GONE = 0.6  # share of its volume that an object has lost if it was taken
MORE = 1.6  # times the expected volume: that is two objects
LEAST_VOLUME = 5e-6  # [m^3] less is noise
NEARBY = 0.12  # [m] from the grasp: what disappears farther away was not taken by it
TOUCHING = 0.006  # [m] between outlines; of one color, they may be one object that was seen as two
TWO_COLORS = "two colors"  # in `SeenObject.why`


@dataclass(frozen=True)
class Check:
    """What is held, and by which observation."""

    held: Held
    why: str = ""
    doubt: str = ""  # why "one" may be two: the container is looked at after the release


def by_width(width: float, holding: bool) -> Check:
    """Return what is held by the width between closed fingers [m]; "" if only a picture shows it."""
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
    remark: str = "",
) -> Check:
    """Return what is held by comparing the tray before and after the lift.

    Objects that touch may be seen as one before and as several afterwards, so volumes count, not numbers. "two" needs
    evidence: another object is missing, or two colors and a measurement. Anything less is a doubt.

    Args:
        taken: the object that the grasp was for.
        place: (x, y) of the grasp in world [m].
        before: objects in the tray before the grasp, those that two images show.
        after: objects in the tray, seen while the arm hides nothing of it.
        remark: how the fingers are wider apart than expected; empty if they are not.
    """
    lost = {thing.id: _lost(thing, after) for thing in before}
    near = [thing for thing in before if thing.id != taken.id and _distance(thing, place) < NEARBY]
    missing = [thing for thing in near if lost[thing.id] >= max(GONE * thing.volume, LEAST_VOLUME)
               and not _moved(thing, before, after)]
    parts = [thing for thing in missing if thing.color_name == taken.color_name and gap(thing, taken) < TOUCHING]
    others = [thing for thing in missing if thing not in parts]
    own = lost.get(taken.id, 0.0)
    if others and own >= GONE * taken.volume:
        return Check("two", f"{taken.id} and {', '.join(thing.id for thing in others)} are missing in the tray")
    expected = max(taken.volume + sum(thing.volume for thing in parts), LEAST_VOLUME)
    total = sum(thing.volume for thing in before) - sum(thing.volume for thing in after)
    amount = f"{1e6 * total:.0f} cm^3 are missing in the tray, not {1e6 * expected:.0f}"
    if others and total > MORE * expected:
        return Check("two", amount)
    if own < (1 - GONE) * taken.volume and total < (1 - GONE) * taken.volume:
        return Check("one", "nothing is missing in the tray")
    measured = [*([remark] if remark else []), *([amount] if total > MORE * expected else [])]
    seen = [TWO_COLORS] if TWO_COLORS in taken.why else []
    if seen and measured:
        return Check("two", f"{taken.id}: {', '.join(seen + measured)}")
    touching = [f"{thing.id} of the same color touched it and is missing" for thing in parts]
    return Check("one", doubt=", ".join([*seen, *measured, *touching]))


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
