"""Which ball comes next: the nearest that is seen, validated, reachable between its neighbours, and not given up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from common import messages as m
from common.applications.pick_place.grasp import grasp_yaws
from common.applications.pick_place.parameters import PickPlaceParameters
from common.applications.pick_place.stages import Cycle, Place, Spots, Target, View, appeared, same_place
from common.config import Container

FULL = "the container is full"
SETTLING = 1.5  # [s] from letting go until the ball lies in the container and was seen there


class Choice:
    """Chooses targets and remembers which places were missed or given up."""

    def __init__(self, parameters: PickPlaceParameters, container: Container, radius: float) -> None:
        """Start with nothing given up.

        Args:
            parameters: shape of the open fingers, what counts as moved, and how often a place is tried.
            container: where balls go.
            radius: of a ball [m].
        """
        self.p, self.container, self.radius = parameters, container, radius
        self._misses: list[tuple[Place, int]] = []
        self._given_up: list[tuple[Target, str, Spots]] = []
        self._judged_by: dict[str, Any] = {}  # values of the parameters
        self._expected = (0, 0.0)  # balls that will be in the container soon, and until when that is only expected

    def next(self, view: View, origin: Sequence[float], under_way: Sequence[Cycle]) -> Cycle | None:
        """The nearest ball to `origin` (x, y) that can be taken, with its yaws; None when there is none now."""
        spots = view.spots(None, self.radius)
        moved, judged_by = self.p.moved, self.p.model_dump(include=set(PickPlaceParameters.model_fields))
        if judged_by != self._judged_by:  # what was impossible may not be so any more
            self._given_up, self._judged_by = [], judged_by
        # Only while the table stays as it was: one ball less may be all that was needed.
        self._given_up = [
            g for g in self._given_up if not appeared(spots, g[2], moved) and not appeared(g[2], spots, moved)
        ]
        full = self._is_full(view, bool(under_way))
        if not full:  # it was emptied, or only expected to be full
            self._given_up = [g for g in self._given_up if g[1] != FULL]
        candidates = [ball for ball in view.balls() if self._is_open(ball, view, under_way)]
        candidates.sort(key=lambda ball: math.dist(ball.position[:2], origin[:2]))
        for ball in candidates:
            others = view.spots(ball, self.radius)
            yaws = grasp_yaws(self.p.hand, ball.position, others, self.radius, self.container)
            if full:
                self.give_up(ball, FULL, view)
            elif not yaws:
                self.give_up(ball, "no turn of the hand clears what stands beside it", view)
            else:
                return Cycle(ball, yaws)
        return None

    def _is_open(self, ball: Target, view: View, under_way: Sequence[Cycle]) -> bool:
        seen = any(math.dist(t[:2], ball.position[:2]) <= self.p.moved for t in view.targets)
        taken = any(same_place(c.target.position, ball.position, self.radius) for c in under_way)
        given_up = any(same_place(g[0].position, ball.position, self.radius) for g in self._given_up)
        return seen and not taken and not given_up

    def _is_full(self, view: View, carrying: bool) -> bool:
        """Whether no slot is left, counting what is on its way into the container."""
        return self._contained(view) + int(carrying) >= 4 * self.container.layers

    def _contained(self, view: View) -> int:
        count, until = self._expected
        return max(len(view.objects("contained")), count if view.scene_stamp < until else 0)

    def released(self, target: Target, view: View) -> None:
        """A ball was let go above the container, where it will be seen when it has come to rest."""
        self._expected = (self._contained(view) + 1, view.now + SETTLING)
        self._forget(target)

    def missed(self, target: Target, view: View) -> None:
        """The fingers closed on nothing there; after `max_retries` retries the place is given up."""
        count = 1 + next((n for p, n in self._misses if same_place(p, target.position, self.radius)), 0)
        self._forget(target)
        if count > self.p.max_retries:
            self.give_up(target, f"the fingers closed on nothing {count} times", view)
        else:
            self._misses.append((target.position, count))

    def _forget(self, target: Target) -> None:
        self._misses = [(p, n) for p, n in self._misses if not same_place(p, target.position, self.radius)]

    def give_up(self, target: Target, reason: str, view: View) -> None:
        """Leave a ball alone until something changes on the table."""
        self._given_up = [g for g in self._given_up if not same_place(g[0].position, target.position, self.radius)]
        self._given_up.append((target, reason, view.spots(None, self.radius)))

    def rejections(self) -> list[m.Rejection]:
        """What is given up now, and why."""
        return [
            m.Rejection(position=m.Vector3(x=t.position[0], y=t.position[1], z=t.position[2]), reason=reason)
            for t, reason, _ in self._given_up
        ]
