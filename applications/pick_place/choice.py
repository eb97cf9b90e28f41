"""Which ball comes next, and which way the hand is turned for it.

The nearest that is seen, validated, not given up, and that the open fingers can reach between its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel, FiniteFloat

from applications.pick_place.detections import HIDDEN
from applications.pick_place.grasping import Config, HandShape
from common import messages as m
from common.config import Container
from common.robot.transforms import matrix_to_rpy, pose_to_matrix
from common.scene.slots import column_at, low_columns
from common.scene.workspace import yaw_candidates
from common.tasks.engine import appeared
from common.tasks.stages import Cycle, Place, View, place_of
from common.tasks.watchdogs import Patience

Spot = tuple[float, float]  # (x, y) [m]
Spots = list[Spot]
YawRange = tuple[float, float]  # its middle, and how far it reaches to either side [rad]
FULL = "the container is full"
FINE = 36  # yaws in half a turn at which it is looked whether the hand is clear
TIPS = 0.012  # [m] by which finger tips reach below the middle of what they grip
SAME_PLACE = 0.02  # [m] what is hidden and a track that is nearer are one object
EMPTY_FOR = 0.5  # [s] a container in which nothing is seen for so long is empty
SETTLING = 1.5  # [s] from letting go until the ball lies in the container and was seen there


@dataclass
class Target:
    """An object that was seen: its place [m] in world, and its track id in the planning scene.

    `size` (x, y) [m] and `yaw` [rad] are those of a box seen from above; what is round has none. `grip_effort` [N]
    and `mass` [kg] are those of the planning scene, 0 where it says none.
    """

    id: str
    position: Place
    radius: float = 0.0  # of the circle about it seen from above [m]
    size: tuple[float, float] | None = None
    yaw: float = 0.0
    grip_effort: float = 0.0
    mass: float = 0.0

    @classmethod
    def of(cls, thing: m.CollisionObject) -> Target:
        """An object of the planning scene."""
        d = thing.dimensions
        if thing.shape != "box":
            return cls(thing.id, place_of(thing.pose), d[0], grip_effort=thing.grip_effort, mass=thing.mass)
        yaw = matrix_to_rpy(pose_to_matrix(thing.pose)[:3, :3])[2]
        radius = math.hypot(d[0], d[1]) / 2
        return cls(thing.id, place_of(thing.pose), radius, (d[0], d[1]), yaw, thing.grip_effort, thing.mass)

    def width(self, yaw: float) -> float | None:
        """Between fingers that are turned by `yaw` [rad] [m]; None where its size is not known."""
        if self.size is None:
            return 2 * self.radius or None
        return self.size[1] if abs(math.cos(yaw - self.yaw)) > math.sqrt(0.5) else self.size[0]


@dataclass(eq=False)
class Pick(Cycle):
    """Taking one object to the container, and the yaws that are still to be tried for it."""

    target: Target = field(kw_only=True)
    yaws: list[float] = field(default_factory=list, kw_only=True)
    ranges: list[YawRange] = field(default_factory=list, kw_only=True)  # of the hand, for what is round
    yaw: float = field(default=0.0, kw_only=True)  # of the hand, of those the one that is tried
    again: bool = field(default=False, kw_only=True)  # there was no way to it from another posture of the arm
    apart: bool = field(default=False, kw_only=True)  # it was asked for a way to any of the yaws once
    over: Spot | None = field(default=None, kw_only=True)  # where it is let go; without, anywhere above the container
    first_error: str = ""

    def __post_init__(self) -> None:
        """Its subject is the target."""
        self.subject = self.target.id


class LetGo(BaseModel):
    """Where the last was let go above each column of the container: its centre [m] once it lies, world."""

    places: list[tuple[FiniteFloat, FiniteFloat, FiniteFloat]] = []


@dataclass
class GivenUp:
    """An object that is left alone until something changes on the table where `spots` are.

    One to which there was no way is tried once more, from another posture of the arm: then it is `open` meanwhile.
    """

    target: Target
    reason: str
    spots: Spots
    retry: bool = False
    open: bool = False


@dataclass
class PickPlaceView(View):
    """What the task knows, and `seen`: the places that were validated in the newest picture."""

    seen: m.PoseArray | None = None

    @property
    def targets(self) -> list[Place]:
        """Where something was seen that may be taken, in world [m]."""
        if self.seen is None:
            return []
        places = [place_of(pose) for pose in self.seen.poses]
        if not self.seen.labels:
            return places
        # What is hidden and was taken meanwhile is still in the picture's memory, but no more in the planning scene.
        known = [ball.position for ball in self.balls()]
        return [place for place, label in zip(places, self.seen.labels, strict=True)
                if label != HIDDEN or any(math.dist(place[:2], one[:2]) <= SAME_PLACE for one in known)]

    @property
    def blind(self) -> str:
        """Why nothing is seen at all; empty when something is."""
        return f"nothing can be seen: {self.seen.unseen}" if self.seen is not None and self.seen.blind else ""

    @property
    def stamps(self) -> tuple[float, ...]:
        """When the picture was taken of which the targets are, and that of which the planning scene is [s]."""
        return (self.seen.header.stamp * 1e-9 if self.seen else 0.0), self.scene_stamp

    def balls(self) -> list[Target]:
        """Balls on the table according to the planning scene, reachable or not."""
        return [Target.of(thing) for thing in self.objects("target")]

    def spots(self, but: Target | None, radius: float) -> Spots:
        """(x, y) of the balls on the table, without the one in work."""
        return [b.position[:2] for b in self.others(but, radius)]

    def others(self, but: Target | None, radius: float) -> list[Target]:
        """Balls on the table, without the one in work."""
        return [b for b in self.balls() if but is None or not same_place(b.position, but.position, radius)]


class Choice:
    """Chooses targets and remembers which places were missed or given up."""

    def __init__(
        self, config: Config, container: Container, radius: float, counted: Callable[[], int] = lambda: 0
    ) -> None:
        """Start with nothing given up.

        Args:
            config: shape of the open fingers, what counts as moved, and how often a place is tried.
            container: where balls go.
            radius: of a ball [m].
            counted: how many balls are known to have come into the container, seen there now or not.
        """
        self.p, self.container, self.radius, self._counted = config, container, radius, counted
        self._misses: list[tuple[Place, int]] = []
        self._given_up: list[GivenUp] = []
        self._judged_by: dict[str, Any] = {}  # values of the parameters
        self._empty = Patience()
        self._expected = (0, 0.0)  # balls that will be in the container soon, and until when that is only expected
        self.let_go = LetGo()

    def next(self, view: PickPlaceView, origin: Sequence[float], under_way: Sequence[Pick]) -> Pick | None:
        """The nearest ball to `origin` (x, y) that can be taken, with its yaws; None when there is none now."""
        spots = view.spots(None, self.radius)
        moved, judged_by = self.p.moved, self.p.model_dump(exclude={"robot", "run", "world", "grasp"})
        if judged_by != self._judged_by:  # what was impossible may not be so any more
            self._given_up, self._judged_by = [], judged_by
        # Only while the table stays as it was: one ball less may be all that was needed.
        self._given_up = [
            g for g in self._given_up if not appeared(spots, g.spots, moved) and not appeared(g.spots, spots, moved)
        ]
        full = self._is_full(view, bool(under_way))
        if not full:  # it was emptied, or only expected to be full
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
                self.give_up(ball, "no turn of the hand clears what stands beside it", view)
            else:
                again = self._given_up_at(ball.position) is not None
                clear = [] if flat is not None else grasp_yaws(
                    self.p.hand, ball.position, others, self.radius, self.container, yaw_candidates(FINE))
                return Pick(target=ball, yaws=yaws, ranges=yaw_ranges(clear), again=again,
                            over=self._over(ball.position, view, under_way))
        return None

    def held(self, name: str, view: PickPlaceView) -> Pick:
        """What is left of a pick whose object is in the hand: a restart or a failure has left nothing else of it."""
        pick = Pick(target=Target(name, view.tool), over=self._over(view.tool, view, []))
        pick.begun = True
        return pick

    def _over(self, place: Place, view: PickPlaceView, under_way: Sequence[Pick]) -> Spot:
        """(x, y) in the container above which there is most room, of those the nearest to a place [m].

        An arm that lets go wherever it comes first heaps up a pile that leans to its side.
        """
        lie = self._lie(view)
        for over in (pick.over for pick in under_way):
            if over is not None:
                lie.append((*over, self._top(over, lie)))
        low = low_columns(self.container, lie, self.radius)
        return min(low, key=lambda column: math.dist(column, place[:2]))

    def _lie(self, view: PickPlaceView) -> list[Place]:
        """What lies in the container, as it is seen and as it was let go, until that is seen to be empty.

        What leans on others may look as if it lay on the floor, where it was let go above another one.
        """
        seen = [place_of(thing.pose) for thing in view.objects("contained")]
        empty = not seen and 0 < view.scene_stamp >= self._expected[1] and not _hidden(view)
        if self._empty.lasts(empty, view.scene_stamp) >= EMPTY_FOR and empty and self.let_go.places:
            self.let_go = LetGo()
        return [*seen, *self.let_go.places]

    def _top(self, over: Spot, lie: Sequence[Place]) -> float:
        """Height [m] of one more above those that lie there."""
        below = [z for x, y, z in lie if math.dist((x, y), over) < self.radius]
        return max(below, default=self.p.world.table_height - self.radius) + 2 * self.radius

    def once_more(self) -> bool:
        """Open again what no plan was found for, each once while the table stays as it is; whether there is any."""
        again = [g for g in self._given_up if g.retry]
        for g in again:
            g.retry, g.open = False, True
        return bool(again)

    def _given_up_at(self, place: Place) -> GivenUp | None:
        return next((g for g in self._given_up if same_place(g.target.position, place, self.radius)), None)

    def _is_open(self, ball: Target, view: PickPlaceView, under_way: Sequence[Pick]) -> bool:
        seen = any(math.dist(t[:2], ball.position[:2]) <= self.p.moved for t in view.targets)
        taken = any(same_place(c.target.position, ball.position, self.radius) for c in under_way)
        left = self._given_up_at(ball.position)
        return seen and not taken and (left is None or left.open)

    def _is_full(self, view: PickPlaceView, carrying: bool) -> bool:
        """Whether no slot is left, counting what is on its way into the container."""
        return self._contained(view) + int(carrying) >= 4 * self.container.layers

    def _contained(self, view: PickPlaceView) -> int:
        count, until = self._expected
        lie = view.objects("contained")
        sure = max(sum(not thing.unseen for thing in lie), self._counted())
        return max(min(len(lie), sure), count if view.scene_stamp < until else 0)

    def released(self, pick: Pick, view: PickPlaceView) -> None:
        """A ball was let go above the container, where it will be seen when it has come to rest."""
        over = column_at(self.container, view.tool[:2])  # where there was no way to above another, anywhere
        place = (*over, self._top(over, self._lie(view)))
        self.let_go = LetGo(places=[*(other for other in self.let_go.places if other[:2] != over), place])
        self._expected = self._contained(view) + 1, view.now + SETTLING
        self._forget(pick.target)

    def missed(self, target: Target, view: PickPlaceView, problem: str) -> None:
        """The fingers did not take there what was seen; after `max_retries` retries the place is given up."""
        count = 1 + next((n for p, n in self._misses if same_place(p, target.position, self.radius)), 0)
        self._forget(target)
        if count > self.p.max_retries:
            self.give_up(target, f"{problem} {count} times", view)
        else:
            self._misses.append((target.position, count))

    def _forget(self, target: Target) -> None:
        self._misses = [(p, n) for p, n in self._misses if not same_place(p, target.position, self.radius)]

    def give_up(self, target: Target, reason: str, view: PickPlaceView, *, retry: bool = False) -> None:
        """Leave a ball alone until something changes on the table, or until it is opened for a retry."""
        if (left := self._given_up_at(target.position)) is not None:
            self._given_up.remove(left)
        self._given_up.append(GivenUp(target, reason, view.spots(None, self.radius), retry))

    def rejections(self) -> list[m.Rejection]:
        """What is given up now, and why."""
        return [
            m.Rejection(position=m.Vector3(x=g.target.position[0], y=g.target.position[1], z=g.target.position[2]),
                        reason=g.reason)
            for g in self._given_up
        ]


def _hidden(view: PickPlaceView) -> bool:
    """Whether part of what the picture should show cannot be seen in it, the container perhaps."""
    return view.seen is None or bool(view.seen.unseen)


def same_place(a: Place, b: Place, radius: float) -> bool:
    """Whether two places are of one ball: two balls are never closer than their diameter, one above the other too."""
    return math.dist(a[:2], b[:2]) < radius and abs(a[2] - b[2]) < radius


def lies_below(ball: Target, balls: Sequence[Target]) -> bool:
    """Whether another one lies on a ball: that is taken first."""
    x, y, z = ball.position
    return any(
        b.position[2] - z > 0.5 * ball.radius and math.dist(b.position[:2], (x, y)) < 0.98 * (b.radius + ball.radius)
        for b in balls
    )


def finger_clearance(
    shape: HandShape, center: Sequence[float], yaw: float, neighbours: Sequence[Sequence[float]], radius: float,
    container: Container | None = None,
) -> float:
    """Least gap [m] between the open fingers and any neighbour, negative when they overlap.

    The fingers open along the tool's y axis, which for the tool pointing down and yaw 0 is the -y axis of the world.

    Args:
        shape: the fingers.
        center: (x, y) of the object to take [m], world.
        yaw: of the tool about world z [rad].
        neighbours: (x, y) of other balls [m], world, and the radius of each if it is not that of the others.
        radius: of the balls [m].
        container: an open box whose walls must be cleared as well.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    half_length = (shape.finger_outer - shape.finger_inner) / 2
    middle = (shape.finger_outer + shape.finger_inner) / 2
    best = math.inf
    for x, y, *own in neighbours:
        dx, dy = x - center[0], y - center[1]
        lateral, along = c * dx + s * dy, -s * dx + c * dy
        gap_lateral = max(abs(lateral) - shape.finger_half_width, 0.0)
        gap_along = max(abs(abs(along) - middle) - half_length, 0.0)
        best = min(best, math.hypot(gap_lateral, gap_along) - (own[0] if own else radius))
    if container is not None:
        best = min(best, _container_gap(shape, center, c, s, container))
    return best


def _container_gap(shape: HandShape, center: Sequence[float], c: float, s: float, container: Container) -> float:
    """Gap between the corners of the fingers and the container's outer square, negative inside."""
    best = math.inf
    for along in (-shape.finger_outer, -shape.finger_inner, shape.finger_inner, shape.finger_outer):
        for lateral in (-shape.finger_half_width, shape.finger_half_width):
            x = center[0] + c * lateral - s * along - container.x
            y = center[1] + s * lateral + c * along - container.y
            dx, dy = abs(x) - container.half_side, abs(y) - container.half_side
            inside = min(max(dx, dy), 0.0)
            best = min(best, math.hypot(max(dx, 0.0), max(dy, 0.0)) + inside)
    return best


def grasp_yaws(
    shape: HandShape, center: Sequence[float], neighbours: Sequence[Sequence[float]], radius: float,
    container: Container | None = None, yaws: Sequence[float] | None = None,
) -> list[float]:
    """Yaws [rad] with clear fingers, the least turn first; empty when the neighbours leave no room.

    `yaws` are those that the object itself allows; any without them.
    """
    near = [n for n in neighbours if math.dist(n[:2], center[:2]) < shape.finger_outer + 2 * radius + 0.05]
    return [
        yaw
        for yaw in (yaw_candidates(shape.yaw_count) if yaws is None else yaws)
        if finger_clearance(shape, center, yaw, near, radius, container) >= shape.min_clearance
    ]


def yaw_ranges(clear: Sequence[float]) -> list[YawRange]:
    """Ranges in a full turn of the hand that `clear` is about, of `yaw_candidates(FINE)`: those next to each other."""
    if len(clear) == FINE:
        return [(0.0, math.pi)]
    step = math.pi / FINE
    free = {round(yaw / step) % FINE for yaw in clear}
    ranges: list[YawRange] = []
    for first in sorted(number for number in free if (number - 1) % FINE not in free):
        count = next(n for n in range(1, FINE + 1) if (first + n) % FINE not in free)
        half = (count - 1) / 2
        middle = (first + half) * step
        ranges += [(math.remainder(middle + turn, 2 * math.pi), half * step) for turn in (0.0, math.pi)]
    return ranges


def yaws_of(target: Target, shape: HandShape) -> list[float] | None:
    """Yaws [rad] of the hand at which its pads lie flat on two sides of a box that fits between them.

    None for what is round, which is taken at any, and for a cup, which takes anything so.
    """
    if target.size is None or not shape.finger_inner:
        return None
    # At the yaw of the box the fingers close along its y axis, a quarter turn from there along its x axis.
    fitting = [target.yaw + turn for width, turn in ((target.size[1], 0.0), (target.size[0], math.pi / 2))
               if width <= 2 * (shape.finger_inner - shape.min_clearance)]
    turned = [math.remainder(yaw, math.pi) for yaw in fitting]  # a parallel gripper repeats after half a turn
    return sorted(turned, key=lambda yaw: (abs(yaw), -yaw))
