"""Which grasps are tried next: the best proved ones, without places where an attempt failed a short time ago."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel

from applications.sorting.rules import NoDestination, Rule
from applications.sorting.topics import GraspCandidate, Heap, SeenObject
from common.robot.transforms import pose_to_matrix

SAME_PLACE = 0.02  # [m]
SAME_DIRECTION = math.radians(30)  # [rad] between the closing directions of two grasps
SAME_OBJECT = 0.03  # [m] an object nearer to a failed attempt is the same one
MOST_OPTIONS = 10  # grasps among which the planner chooses
WITHIN = 0.1  # of the best score


@dataclass(frozen=True)
class Option:
    """A grasp that may be next, its object and where that goes."""

    grasp: GraspCandidate
    thing: SeenObject
    container: str


class Failure(BaseModel):
    """An attempt that failed: position and closing direction of the grasp in world, and when [s]."""

    place: tuple[float, float, float]
    closing: tuple[float, float, float]
    at: float
    reason: str


class Choice:
    """Ranks grasps by their score, and remembers failed ones.

    Attributes:
        failures: the newest last.
    """

    def __init__(self, rule: Rule, tray: str, closing_axis: str) -> None:
        """Choose by a rule among objects in a tray and outside of all containers.

        Args:
            rule: names the container of an object.
            tray: id of the container that objects are taken from.
            closing_axis: x or y of the tool, along which the fingers close.
        """
        self._rule, self._tray, self._axis = rule, tray, 1 if closing_axis == "y" else 0
        self.failures: list[Failure] = []

    def is_left(self, thing: SeenObject) -> bool:
        """Return whether an object still has to be sorted: it lies in the tray or outside of all containers."""
        return thing.place in (self._tray, "table", "floor")

    def left(self, heap: Heap) -> list[SeenObject]:
        """Return the objects that still have to be sorted."""
        return [thing for thing in heap.objects if self.is_left(thing)]

    def options(self, heap: Heap, now: float, penalty: float, most_tries: int) -> list[Option]:
        """Return the grasps that may be next, the best first; empty if there is none.

        Args:
            heap: what the cameras see.
            now: time [s].
            penalty: how long a failed place is avoided [s].
            most_tries: failed attempts at one object until it is given up.
        """
        found = list(self._allowed(heap, now, penalty, most_tries))
        found.sort(key=lambda one: -one.grasp.score)
        best = found[0].grasp.score if found else 0.0
        return [one for one in found if one.grasp.score >= best - WITHIN][:MOST_OPTIONS]

    def _allowed(self, heap: Heap, now: float, penalty: float, most_tries: int) -> Iterator[Option]:
        things = {thing.id: thing for thing in self.left(heap)}
        destinations: dict[str, str] = {}
        for name, thing in things.items():
            try:
                if self.tries(thing) < most_tries:
                    destinations[name] = self._rule.destination(thing)
            except NoDestination:
                continue
        for grasp in heap.grasps:
            if grasp.proved and grasp.object in destinations and not self._penalized(grasp, now, penalty):
                yield Option(grasp, things[grasp.object], destinations[grasp.object])

    def _penalized(self, grasp: GraspCandidate, now: float, penalty: float) -> bool:
        place, closing = self._place_of(grasp)
        return any(
            now - failure.at < penalty and math.dist(place, failure.place) < SAME_PLACE
            and _between(closing, failure.closing) < SAME_DIRECTION for failure in self.failures)

    def _place_of(self, grasp: GraspCandidate) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        T = pose_to_matrix(grasp.pose)
        x, y, z = T[:3, 3].tolist()
        a, b, c = T[:3, self._axis].tolist()
        return (x, y, z), (a, b, c)

    def penalize(self, grasp: GraspCandidate, now: float, reason: str) -> None:
        """Remember that an attempt failed."""
        place, closing = self._place_of(grasp)
        self.failures = [*self.failures[-199:], Failure(place=place, closing=closing, at=now, reason=reason)]

    def tries(self, thing: SeenObject) -> int:
        """Return the number of failed attempts at an object, by its position."""
        return sum(self._is_at(failure, thing) for failure in self.failures)

    def _is_at(self, failure: Failure, thing: SeenObject) -> bool:
        reach = SAME_OBJECT + max(thing.size.x, thing.size.y) / 4
        return math.dist(failure.place[:2], (thing.center.x, thing.center.y)) < reach

    def forget(self) -> None:
        """Allow everything again: the objects were moved."""
        self.failures = []

    def reason(self, thing: SeenObject, heap: Heap) -> str:
        """Return why an object is not taken."""
        try:
            self._rule.destination(thing)
        except NoDestination as error:
            return str(error)
        if failed := [failure for failure in self.failures if self._is_at(failure, thing)]:
            return f"{len(failed)} attempts failed, the last one: {failed[-1].reason}"
        found = next((left.reason for left in heap.left if left.object == thing.id), "")
        why = next((grasp.why for grasp in heap.grasps if grasp.object == thing.id and not grasp.proved), "")
        where = "" if thing.place == self._tray else f"it lies on the {thing.place}, outside of the tray: "
        return f"{where}{found or why or 'no grasp was found'}"


def _between(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    """Angle between two closing directions [rad]; opposite ones are the same."""
    return math.acos(min(1.0, abs(float(np.dot(a, b)))))
