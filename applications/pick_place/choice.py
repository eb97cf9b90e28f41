"""Choose the next ball and the gripper yaws for it; count the balls in the container and on the table.

The next ball is the nearest one that is seen, validated, not abandoned, and free for the open fingers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, FiniteFloat

from applications.pick_place.detections import HIDDEN
from applications.pick_place.grasping import FINE, Config, Target, YawRange, grasp_yaws, yaw_ranges, yaws_of
from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from common.config import Container
from common.scene.fixtures import column_at, low_columns
from common.scene.workspace import yaw_candidates
from common.tasks.engine import appeared
from common.tasks.stages import Cycle, DwellTimer, Place, View, place_of

Spot = tuple[float, float]  # (x, y) [m]
Spots = list[Spot]
FULL = "the container is full"
TIPS = 0.012  # [m] reach of the finger tips below the center of a gripped object
SAME_PLACE = 0.02  # [m] an occluded target and a track closer than this are one object
EMPTY_FOR = 0.5  # [s] without detections after which a container is empty
CONTAINED_FOR = 0.5  # [s] for which balls must be seen in the container to count
AT_REST = 0.3  # [s] for which a dropped ball must be seen at one position: it may still roll out of view
SETTLING = 1.5  # [s] from the release until the ball is at rest in the container and was seen there


@dataclass(eq=False)
class Pick(Cycle):
    """One object on its way to the container, and the gripper yaws still to try."""

    target: Target = field(kw_only=True)
    yaws: list[float] = field(default_factory=list, kw_only=True)
    ranges: list[YawRange] = field(default_factory=list, kw_only=True)  # gripper yaws, for round objects
    yaw: float = field(default=0.0, kw_only=True)  # gripper yaw of the current attempt
    again: bool = field(default=False, kw_only=True)  # planning failed from another arm posture before
    apart: bool = field(default=False, kw_only=True)  # a plan to any of the yaws was requested once
    over: Spot | None = field(default=None, kw_only=True)  # release position; None: anywhere above the container
    first_error: str = ""

    def __post_init__(self) -> None:
        """Use the target's id as the subject."""
        self.subject = self.target.id


class ReleasePositions(BaseModel):
    """Center of the last ball released above each column of the container, at rest [m], world."""

    places: list[tuple[FiniteFloat, FiniteFloat, FiniteFloat]] = []


@dataclass
class AbandonedTarget:
    """An object that is ignored until something changes on the table, given as `spots`.

    After a failed plan it gets one retry from another arm posture; `open` is set for the retry.
    """

    target: Target
    reason: str
    spots: Spots
    retry: bool = False
    open: bool = False


@dataclass
class PickPlaceView(View):
    """View with `seen`, the validated targets of the newest image."""

    seen: m.PoseArray | None = None

    @property
    def targets(self) -> list[Place]:
        """Positions of the targets in world [m]."""
        if self.seen is None:
            return []
        places = [place_of(pose) for pose in self.seen.poses]
        if not self.seen.labels:
            return places
        # An occluded ball taken meanwhile is still a remembered target, but no longer in the planning scene.
        known = [ball.position for ball in self.balls()]
        return [place for place, label in zip(places, self.seen.labels, strict=True)
                if label != HIDDEN or any(math.dist(place[:2], one[:2]) <= SAME_PLACE for one in known)]

    @property
    def blind(self) -> str:
        """Why the camera sees nothing at all; empty when it sees something."""
        return f"nothing can be seen: {self.seen.unseen}" if self.seen is not None and self.seen.blind else ""

    @property
    def stamps(self) -> tuple[float, ...]:
        """Times of the images of the targets and of the planning scene [s]."""
        return (self.seen.header.stamp * 1e-9 if self.seen else 0.0), self.scene_stamp

    def balls(self) -> list[Target]:
        """Return the balls on the table according to the planning scene, reachable or not."""
        return [Target.of(thing) for thing in self.objects("target")]

    def spots(self, but: Target | None, radius: float) -> Spots:
        """Return (x, y) of the balls on the table except one."""
        return [b.position[:2] for b in self.others(but, radius)]

    def others(self, but: Target | None, radius: float) -> list[Target]:
        """Return the balls on the table except one."""
        return [b for b in self.balls() if but is None or not same_place(b.position, but.position, radius)]


class Choice:
    """Chooses targets; remembers failed grasps and abandoned objects."""

    def __init__(
        self, config: Config, container: Container, radius: float, counted: Callable[[], int] = lambda: 0
    ) -> None:
        """Start with nothing abandoned.

        Args:
            config: shape of the open fingers, motion threshold, retries.
            container: destination.
            radius: of a ball [m].
            counted: number of balls known to be in the container, visible or not.
        """
        self.p, self.container, self.radius, self._counted = config, container, radius, counted
        self._misses: list[tuple[Place, int]] = []
        self._given_up: list[AbandonedTarget] = []
        self._judged_by: dict[str, Any] = {}  # parameter values
        self._empty = DwellTimer()
        self._expected = (0, 0.0)  # balls expected in the container, and until when they count unseen [s]
        self.releases = ReleasePositions()

    def next(self, view: PickPlaceView, origin: Sequence[float], under_way: Sequence[Pick]) -> Pick | None:
        """Return the nearest takable ball to `origin` (x, y) with its yaws; None when there is none."""
        spots = view.spots(None, self.radius)
        moved, judged_by = self.p.moved, self.p.model_dump(exclude={"robot", "run", "world", "grasp"})
        if judged_by != self._judged_by:  # changed parameters may make it possible
            self._given_up, self._judged_by = [], judged_by
        # Only while the table is unchanged: one ball less may be enough.
        self._given_up = [
            g for g in self._given_up if not appeared(spots, g.spots, moved) and not appeared(g.spots, spots, moved)
        ]
        full = self._is_full(view, bool(under_way))
        if not full:  # emptied, or only expected to be full
            self._given_up = [g for g in self._given_up if g.reason != FULL]
        balls = view.balls()
        candidates = [ball for ball in balls if self._is_open(ball, view, under_way) and not lies_below(ball, balls)]
        candidates.sort(key=lambda ball: math.dist(ball.position[:2], origin[:2]))
        for ball in candidates:
            others = [(*b.position[:2], b.radius) for b in view.others(ball, self.radius)
                      if b.position[2] + b.radius > ball.position[2] - TIPS]
            flat = yaws_of(ball, self.p.hand)
            yaws = grasp_yaws(self.p.hand, ball.position, others, self.radius, self.container, flat)
            if full:
                self.give_up(ball, FULL, view)
            elif not yaws:
                self.give_up(ball, "its neighbors leave no room for the fingers at any yaw", view)
            else:
                again = self._given_up_at(ball.position) is not None
                clear = [] if flat is not None else grasp_yaws(
                    self.p.hand, ball.position, others, self.radius, self.container, yaw_candidates(FINE))
                return Pick(target=ball, yaws=yaws, ranges=yaw_ranges(clear), again=again,
                            over=self._over(ball.position, view, under_way))
        return None

    def held(self, name: str, view: PickPlaceView) -> Pick:
        """Return the rest of a pick whose object is already held, after a restart or a failure."""
        pick = Pick(target=Target(name, view.tool), over=self._over(view.tool, view, []))
        pick.started = True
        return pick

    def _over(self, place: Place, view: PickPlaceView, under_way: Sequence[Pick]) -> Spot:
        """Return the (x, y) above the lowest columns of the container, nearest to a position [m].

        Always releasing at the nearest point would pile the balls up on one side.
        """
        lie = self._lie(view)
        for over in (pick.over for pick in under_way):
            if over is not None:
                lie.append((*over, self._top(over, lie)))
        low = low_columns(self.container, lie, self.radius)
        return min(low, key=lambda column: math.dist(column, place[:2]))

    def _lie(self, view: PickPlaceView) -> list[Place]:
        """Return what lies in the container: detections and recorded releases, until it is seen empty.

        A ball leaning on others may look as if it lay on the floor although it was released above another one.
        """
        seen = [place_of(thing.pose) for thing in view.objects("contained")]
        empty = not seen and 0 < view.scene_stamp >= self._expected[1] and not _hidden(view)
        if self._empty.elapsed(empty, view.scene_stamp) >= EMPTY_FOR and empty and self.releases.places:
            self.releases = ReleasePositions()
        return [*seen, *self.releases.places]

    def _top(self, over: Spot, lie: Sequence[Place]) -> float:
        """Height of the center of one more ball on top of a column [m]."""
        below = [z for x, y, z in lie if math.dist((x, y), over) < self.radius]
        return max(below, default=self.p.world.table_height - self.radius) + 2 * self.radius

    def allow_retries(self) -> bool:
        """Allow one retry for every target without a plan; return whether there is any."""
        again = [g for g in self._given_up if g.retry]
        for g in again:
            g.retry, g.open = False, True
        return bool(again)

    def _given_up_at(self, place: Place) -> AbandonedTarget | None:
        return next((g for g in self._given_up if same_place(g.target.position, place, self.radius)), None)

    def _is_open(self, ball: Target, view: PickPlaceView, under_way: Sequence[Pick]) -> bool:
        seen = any(math.dist(t[:2], ball.position[:2]) <= self.p.moved for t in view.targets)
        taken = any(same_place(c.target.position, ball.position, self.radius) for c in under_way)
        left = self._given_up_at(ball.position)
        return seen and not taken and (left is None or left.open)

    def _is_full(self, view: PickPlaceView, carrying: bool) -> bool:
        """Return whether no slot is left, including the ball on its way."""
        return self._contained(view) + int(carrying) >= 4 * self.container.layers

    def _contained(self, view: PickPlaceView) -> int:
        count, until = self._expected
        lie = view.objects("contained")
        sure = max(sum(not thing.unseen for thing in lie), self._counted())
        return max(min(len(lie), sure), count if view.scene_stamp < until else 0)

    def released(self, pick: Pick, view: PickPlaceView) -> None:
        """Record the release of a ball above the container; it is seen there once it is at rest."""
        over = column_at(self.container, view.tool[:2])  # the fallback goal is anywhere above it
        place = (*over, self._top(over, self._lie(view)))
        others = (other for other in self.releases.places if other[:2] != over)
        self.releases = ReleasePositions(places=[*others, place])
        self._expected = self._contained(view) + 1, view.now + SETTLING
        self._forget(pick.target)

    def missed(self, target: Target, view: PickPlaceView, problem: str) -> None:
        """Record a failed grasp; after `max_retries` retries the position is abandoned."""
        count = 1 + next((n for p, n in self._misses if same_place(p, target.position, self.radius)), 0)
        self._forget(target)
        if count > self.p.max_retries:
            self.give_up(target, f"{problem} {count} times", view)
        else:
            self._misses.append((target.position, count))

    def _forget(self, target: Target) -> None:
        self._misses = [(p, n) for p, n in self._misses if not same_place(p, target.position, self.radius)]

    def give_up(self, target: Target, reason: str, view: PickPlaceView, *, retry: bool = False) -> None:
        """Ignore a ball until something changes on the table, or until its retry."""
        if (left := self._given_up_at(target.position)) is not None:
            self._given_up.remove(left)
        self._given_up.append(AbandonedTarget(target, reason, view.spots(None, self.radius), retry))

    def was_given_up(self, target: Target) -> bool:
        """Return whether a ball was abandoned before, and may be in its retry."""
        return self._given_up_at(target.position) is not None

    def rejections(self) -> list[m.Rejection]:
        """Return the abandoned objects with the reasons."""
        return [
            m.Rejection(position=m.Vector3(x=g.target.position[0], y=g.target.position[1], z=g.target.position[2]),
                        reason=g.reason)
            for g in self._given_up
        ]


class ObjectCounter:
    """Counts the objects in the container and on the table, for the status of the task."""

    def __init__(self, config: Config) -> None:
        """Start with nothing counted."""
        self.p = config
        self.expected = 0  # number of objects when one fell out of the gripper, until all are seen again
        self.released = False  # whether this task has released an object
        self._contained, self._still = DwellTimer(), DwellTimer()
        self._carried = False
        self._spots: Spots = []  # positions of the visible objects while they stay

    def update(self, view: PickPlaceView, status: PickPlaceStatus, *, releases: bool, counts_table: bool) -> None:
        """Count objects in the container, and objects on the table while none is held or falling.

        Objects in the container were placed before a restart of the task, or by another program; a restarted scene
        manager may report them later. A released ball counts at its release: before, it may hang above others, and an
        image shows one more.

        Args:
            view: what the task knows.
            status: gets `done` and `total`.
            releases: a ball is being released, or will be at the end of the running motion.
            counts_table: no ball is being moved, and the image is newer than the last motion.
        """
        if self._carried and not view.holding and not releases:
            self.expected, self._spots = max(self.expected, status.total), []
        self._carried = view.holding and not releases
        contained = self.contained(view)
        if releases:
            self._contained.reset()
        elif self._contained.elapsed(contained, view.scene_stamp) >= min(CONTAINED_FOR, self.p.empty):
            status.done = max(status.done, contained)
        if counts_table and not view.holding:
            found = status.done + len(view.targets)
            if found >= self.expected and self._are_still(view):
                self.expected = 0
            status.total = max(found, self.expected)

    def contained(self, view: PickPlaceView) -> int:
        """Return the number of objects in the container: only visible ones once this task has placed some.

        Before that, objects below visible ones count as well. A rolling object appears in one slot after another; what
        would carry it was counted already, or does not exist.
        """
        return sum(not (self.released and thing.unseen) for thing in view.objects("contained"))

    def _are_still(self, view: PickPlaceView) -> bool:
        """Return whether everything on the table has stayed at its position for a while."""
        spots = [place[:2] for place in view.targets]
        if any(all(math.dist(spot, before) > self.p.moved for before in self._spots) for spot in spots):
            self._spots = spots
            self._still.reset()
        return self._still.elapsed(True, min(view.stamps)) >= AT_REST


def _hidden(view: PickPlaceView) -> bool:
    """Return whether part of the image is occluded, perhaps the container."""
    return view.seen is None or bool(view.seen.unseen)


def same_place(a: Place, b: Place, radius: float) -> bool:
    """Return whether two positions belong to one ball: different balls are at least a diameter apart."""
    return math.dist(a[:2], b[:2]) < radius and abs(a[2] - b[2]) < radius


def lies_below(ball: Target, balls: Sequence[Target]) -> bool:
    """Return whether another ball lies on this one; that one is taken first."""
    x, y, z = ball.position
    return any(
        b.position[2] - z > 0.5 * ball.radius and math.dist(b.position[:2], (x, y)) < 0.98 * (b.radius + ball.radius)
        for b in balls
    )
