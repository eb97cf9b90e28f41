"""The truth beside simulated hardware: where everything really is. Read by the camera, by nothing that decides.

Grasping, carrying, falling and coming to rest are simulated; pushing a ball aside, and rolling, are not: a ball that
can not stay where it falls appears at the nearest place where it can.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters, Tunable, World
from common.errors import ConfigError, Refused, UnknownName
from common.messages import Header, Pose, PoseArray, SceneUpdate, Vector3, WorldEdit, WorldObjects
from common.sim.places import Slot, Slots, Table
from common.sim.standing import StandingBall
from common.sim.standing_objects import Place, StandingObjects

Array = NDArray[np.float64]
BallState = Literal["table", "held", "falling", "box", "elsewhere"]

GRAVITY = 9.81  # [m/s^2]
OPS = {"add": "added", "remove": "removed", "drop": "dropped"}  # what is done to it, by the name of an edit
FLOOR_BELOW_TABLE = 0.75  # what falls off the table lies this far below its surface [m]


class GraspTolerances(Parameters):
    """Where a ball must be for the fingers to catch it, in the frame of the tool centre point."""

    across: Tunable[float] = Field(
        0.010, gt=0, le=0.05, description="centre from the finger pads' middle, tool x axis [m]"
    )
    along: Tunable[float] = Field(
        0.010, gt=0, le=0.05, description="centre from the tool centre point, tool z axis [m]"
    )
    sideways: Tunable[float] = Field(
        0.002, ge=0, le=0.05, description="a ball may overlap an open finger by this, tool y [m]"
    )
    release: Tunable[float] = Field(0.002, gt=0, le=0.02, description="let go when the fingers are this much wider [m]")


@dataclass
class _Ball:
    """A ball. Held: `grip` is its centre in the TCP frame. Falling: from `dropped` at `since`, to lie at `rest`."""

    position: Array
    state: BallState
    slot: Slot | None = None
    grip: Array | None = None
    dropped: float = 0.0
    since: float = 0.0
    rest: Array | None = None


class SimulatedWorld:
    """The balls, and what becomes of them while a hand moves among them; and other objects, which only a person moves.

    Attributes:
        version: grows whenever something has changed.
        objects_version: grows whenever an object other than a ball stands elsewhere.
    """

    def __init__(
        self, world: World, layout: Sequence[tuple[float, float]], tolerances: GraspTolerances | None = None
    ) -> None:
        """Put a ball at each place of the layout [m]; a place above the container puts it into the container.

        Raises:
            ConfigError: a place where no ball can lie.
        """
        self.version = self.objects_version = 0
        self._config = world
        self._radius = world.ball_radius
        self._tolerances = tolerances or GraspTolerances()
        self._table, self._slots = Table(world), Slots(world)
        self._layout = [(float(x), float(y)) for x, y in layout]
        self._balls: dict[str, _Ball] = {}
        self._objects = StandingObjects(world)
        self._between: set[str] = set()
        self._events: list[SceneUpdate] = []
        try:
            self._lay_out()
        except Refused as refusal:
            raise ConfigError("world.balls", self._layout, f"can not be laid out: {refusal}") from None
        self._events.clear()

    # --- over a restart ---

    @property
    def layout(self) -> list[tuple[float, float]]:
        """Where the balls lay at first (x, y) [m]."""
        return self._layout

    @property
    def objects_layout(self) -> dict[str, Place]:
        """Where the other objects stood at first (x, y) [m]."""
        return self._objects.layout

    @property
    def places(self) -> dict[str, Place]:
        """Where the other objects stand now (x, y) [m]."""
        return self._objects.places

    def standing(self) -> dict[str, StandingBall]:
        """All balls, for `restore`."""
        return {
            name: StandingBall(
                position=_triple(ball.position), state=ball.state, slot=ball.slot, dropped=ball.dropped,
                since=ball.since, grip=None if ball.grip is None else _triple(ball.grip),
                rest=None if ball.rest is None else _triple(ball.rest),
            )
            for name, ball in self._balls.items()
        }

    def restore(self, balls: Mapping[str, StandingBall], places: Mapping[str, Place]) -> None:
        """Put all balls, and the other objects at `places`, where they were."""
        self._objects.restore(places)
        self.objects_version += 1
        self._balls = {
            name: _Ball(
                np.array(ball.position), ball.state, ball.slot, None if ball.grip is None else np.array(ball.grip),
                ball.dropped, ball.since, None if ball.rest is None else np.array(ball.rest),
            )
            for name, ball in balls.items()
        }
        self.version += 1

    # --- the hand ---

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """The width [m] that the fingers can not close below: what is between them now, or 0.

        Args:
            T_world_tcp: (4, 4) pose of the hand; its y axis is the direction in which the fingers open.
            width: between the inner faces of the fingers [m].
        """
        if self.held:
            return 2 * self._radius
        allowed = self._tolerances
        reach = allowed.across + allowed.along + max(width / 2, self._radius)
        height = T_world_tcp[2, 3]
        found = set()
        for name, ball in self._balls.items():
            if ball.state not in ("table", "box") or abs(ball.position[2] - height) > reach:
                continue
            x, y, z = np.abs(T_world_tcp[:3, :3].T @ (ball.position - T_world_tcp[:3, 3]))
            reachable = x <= allowed.across and z <= allowed.along
            # Once clear of both fingers it stays between them: the closing finger pushes it to the middle.
            room = width / 2 - self._radius
            enters = room >= 0 and y <= room + allowed.sideways
            if reachable and (enters or (name in self._between and y < max(width / 2, self._radius))):
                found.add(name)
        self._between = found
        return 2 * self._radius if found else 0.0

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Move on to a time: grasp what the fingers press on, carry it, let it go, let it fall.

        Args:
            now: cell time [s].
            T_world_tcp: (4, 4) pose of the hand.
            width: between the fingers [m].
            gripping: whether the fingers press on something.
        """
        held = self.held
        if not held and gripping and self._between:
            held = min(self._between, key=lambda n: float(np.linalg.norm(self._balls[n].position - T_world_tcp[:3, 3])))
            self._grasp(held, T_world_tcp, now)
        if held:
            self._carry(self._balls[held], T_world_tcp)
            if width > 2 * self._radius + self._tolerances.release:
                self._release(held, now)
        for name, ball in self._balls.items():
            if ball.state == "falling":
                self._fall(name, ball, now)

    def _grasp(self, name: str, T_world_tcp: Array, now: float) -> None:
        ball = self._balls[name]
        grip = T_world_tcp[:3, :3].T @ (ball.position - T_world_tcp[:3, 3])
        grip[1] = 0.0  # the fingers centre it
        slot = ball.slot
        ball.state, ball.grip, ball.slot = "held", grip, None
        self._between = set()
        self._say("remove", name)
        self._sink(slot, now)

    def _carry(self, ball: _Ball, T_world_tcp: Array) -> None:
        assert ball.grip is not None
        position = T_world_tcp[:3, :3] @ ball.grip + T_world_tcp[:3, 3]
        if not np.array_equal(position, ball.position):
            ball.position = position
            self.version += 1

    def _release(self, name: str, now: float) -> None:
        ball = self._balls[name]
        x, y = float(ball.position[0]), float(ball.position[1])
        ball.slot = self._slots.choose(x, y, self._taken(name)) if self._slots.over(x, y) else None
        if ball.slot is not None:
            ball.rest = self._slots.position(ball.slot)
        else:
            place = self._table.nearest_free(x, y, self._places(name)) if self._table.carries(x, y) else None
            below = self._config.table_height - FLOOR_BELOW_TABLE + self._radius
            ball.rest = np.array([*place, self._table.height + self._radius]) if place else np.array([x, y, below])
        self._drop(ball, now)

    def _drop(self, ball: _Ball, now: float) -> None:
        ball.state, ball.grip, ball.dropped, ball.since = "falling", None, float(ball.position[2]), now
        self.version += 1

    def _fall(self, name: str, ball: _Ball, now: float) -> None:
        assert ball.rest is not None
        self.version += 1
        z = ball.dropped - GRAVITY * (now - ball.since) ** 2 / 2
        if z > ball.rest[2]:
            ball.position = np.array([ball.position[0], ball.position[1], z])
            return
        ball.position, ball.rest = ball.rest, None
        if ball.slot is None and ball.position[2] < self._table.height:
            ball.state = "elsewhere"
            return
        ball.state = "table" if ball.slot is None else "box"
        self._say("add", name)

    def _sink(self, slot: Slot | None, now: float) -> None:
        """Let the balls above a slot that was vacated fall by one layer."""
        if slot is None:
            return
        layer, index = slot
        for name, ball in self._balls.items():
            if ball.slot is not None and ball.slot[1] == index and ball.slot[0] > layer:
                ball.slot = (ball.slot[0] - 1, index)
                ball.rest = self._slots.position(ball.slot)
                if ball.state == "box":
                    self._say("remove", name)
                    self._drop(ball, now)

    # --- edits ---

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as a person asks; the id of what was changed, empty for a reset.

        Raises:
            Refused: says why, and what would do. Nothing has changed then.
        """
        if request.op == "reset":
            return self._reset()
        name = request.id
        if name in self._objects:
            return self._move_object(request)
        if self._config.objects and not self._layout and request.op in ("add", "drop"):
            raise Refused("no_balls", f"this world has objects and no balls: {', '.join(self._objects.places)} can be "
                                      "moved, nothing be added")
        if request.op == "drop":
            return self._slip(name, now)
        if request.op == "add":
            name = name or next(n for i in range(1, len(self._balls) + 2) if (n := f"ball_{i}") not in self._balls)
            if name in self._balls:
                raise Refused("id_exists", f"id: {name!r} exists already; leave it empty for a new one")
            if not re.fullmatch(r"[A-Za-z0-9_.-]{1,60}", name):
                raise Refused("bad_id", f"id: {name[:60]!r} must be letters, digits, '_', '.' and '-', at most 60")
        elif name not in self._balls:
            movable = [*self._balls, *self._objects.places] if request.op == "move" else list(self._balls)
            raise Refused("unknown_id", str(UnknownName("object" if self._objects.places else "ball", name, movable)))
        new = None
        if request.op != "remove":
            if request.position is None:
                raise Refused("no_position", f"position: {request.op} needs one, for example {{x: 0.5, y: 0.0}}")
            new = self._laid_down(name, request.position.x, request.position.y)
        old = self._balls.get(name)
        if old is not None and old.state in ("table", "box"):
            self._say("remove", name)
        if new is not None:
            self._balls[name] = new
            self._say("add", name)
        else:
            del self._balls[name]
        self._between.discard(name)
        if old is not None and old.slot is not None and (new is None or new.slot != old.slot):
            self._sink(old.slot, now)
        self.version += 1
        return name

    def _move_object(self, request: WorldEdit) -> str:
        """Move an object that is no ball; its id."""
        if request.op != "move":
            raise Refused("no_ball", f"{request.id} is no ball: it can be moved, but not be {OPS[request.op]}")
        if request.position is None:
            raise Refused("no_position", "position: move needs one, for example {x: 0.5, y: 0.0}")
        self._objects.move(request.id, request.position.x, request.position.y)
        self.objects_version += 1
        self.version += 1
        return request.id

    def _slip(self, name: str, now: float) -> str:
        """Let the held ball slip out of the fingers, which close on without it; its id. Raises Refused without one."""
        held = self.held
        if not held or name not in ("", held):
            raise Refused("not_held", f"{name or 'no ball'} is {'not ' if name else ''}between the fingers")
        self._release(held, now)
        return held

    def _reset(self) -> str:
        for name, ball in self._balls.items():
            if ball.state in ("table", "box"):
                self._say("remove", name)
        self._balls, self._between = {}, set()
        self._lay_out()
        self._objects.reset()
        self.objects_version += 1
        return ""

    def _lay_out(self) -> None:
        for index, (x, y) in enumerate(self._layout):
            name = f"ball_{index + 1}"
            self._balls[name] = self._laid_down(name, x, y)
            self._say("add", name)

    def _laid_down(self, name: str, x: float, y: float) -> _Ball:
        """The ball as it lies at (x, y), in the container or on the table. Raises Refused where it can not."""
        if self._slots.inside(x, y):
            slot = self._slots.choose(x, y, self._taken(name))
            if slot is None:
                box = self._config.container.id
                raise Refused("container_full", f"{box} is full: it holds {self._slots.count} balls")
            return _Ball(self._slots.position(slot), "box", slot)
        if not self._table.carries(x, y):
            raise Refused("off_table", f"({x:g}, {y:g}) is not on the table: {self._table.extent()}")
        if blocker := self._table.blocked(x, y):
            raise Refused("occupied", f"a ball at ({x:g}, {y:g}) would reach into {blocker}")
        place = np.array([x, y, self._table.height + self._radius])
        for other, there in self._lying(name):
            distance = float(np.linalg.norm(there - place))
            if distance < 2 * self._radius - 1e-9:
                raise Refused("occupied", f"({x:g}, {y:g}) overlaps {other}: {distance * 1000:.0f} mm between "
                                          f"centres, at least {2000 * self._radius:.0f} are needed")
        return _Ball(place, "table")

    # --- what there is ---

    @property
    def ids(self) -> list[str]:
        """The ids of the balls, then those of the other objects."""
        return [*self._balls, *self._objects.places]

    @property
    def held(self) -> str:
        """The ball between the fingers, or an empty string."""
        return next((name for name, ball in self._balls.items() if ball.state == "held"), "")

    def counts(self) -> dict[BallState, int]:
        """How many balls are in each state."""
        states: list[BallState] = ["table", "held", "falling", "box", "elsewhere"]
        return {state: sum(ball.state == state for ball in self._balls.values()) for state in states}

    def scene_balls(self, header: Header) -> PoseArray:
        """Where every ball is, with ids and states as labels; those "elsewhere" are off the table, out of sight."""
        return PoseArray(
            header=header,
            poses=[_pose(ball.position) for ball in self._balls.values()],
            ids=list(self._balls),
            labels=[ball.state for ball in self._balls.values()],
        )

    def scene_objects(self, header: Header) -> WorldObjects:
        """Where the other objects stand."""
        return WorldObjects(header=header, objects=self._objects.solids)

    def take_events(self) -> list[SceneUpdate]:
        """What was taken away or came to lie since the last call, in order."""
        events, self._events = self._events, []
        return events

    def _say(self, what: Literal["add", "remove"], name: str) -> None:
        pose = _pose(self._balls[name].position) if what == "add" else None
        self._events.append(SceneUpdate(data=f"{what}:{name}", pose=pose))
        self.version += 1

    def _taken(self, but: str) -> list[Slot]:
        return [ball.slot for name, ball in self._balls.items() if ball.slot is not None and name != but]

    def _lying(self, but: str) -> list[tuple[str, Array]]:
        """Centres (3,) of the balls on the table, of those that are falling to it, and of the one that is held."""
        return [
            (name, ball.position if ball.rest is None else ball.rest)
            for name, ball in self._balls.items()
            if name != but and ball.slot is None
        ]

    def _places(self, but: str) -> Array:
        """The same seen from above (N, 2), without what lies below the table."""
        return np.array([there[:2] for _, there in self._lying(but) if there[2] > self._table.height]).reshape(-1, 2)


def _triple(position: Array) -> tuple[float, float, float]:
    x, y, z = position.tolist()
    return x, y, z


def _pose(position: Array) -> Pose:
    return Pose(position=Vector3(x=float(position[0]), y=float(position[1]), z=float(position[2])))
