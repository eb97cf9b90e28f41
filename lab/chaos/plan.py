"""Which faults happen to a cell, and when: the same seed makes the same plan. Nothing happens here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Literal, get_args

import numpy as np

from common.config import World
from common.messages import WorldObject, WorldObjects
from common.sim.kinematic import GRAVITY
from common.sim.layout import sphere_in_image
from drivers.mujoco.scene import ROLLING

Kind = Literal["kill", "restart", "freeze", "delay", "corrupt", "replay", "drop"]
Form = Literal["", "truncated", "flipped", "noise", "wrong type", "huge"]

PER_MINUTE = 30.0  # faults per minute of wall time
MOST_PER_MINUTE = 600.0
CELL_SECONDS = 80.0  # of cell time in which a run sees faults; what comes after is left to it to finish
LEAST_GAP = 0.05  # [s] between two faults
LEFT_STOPPED = 0.25  # share of what is stopped that stays so until a watchdog takes notice
HOLDING = 0.4  # share of the faults of processes that wait for an object in the hand
STATELESS_FORMS: tuple[Form, ...] = ("noise", "wrong type", "huge")  # for which no real message is needed

LABELS: dict[Kind, str] = {
    "kill": "kill -9", "restart": "SIGTERM", "freeze": "SIGSTOP", "delay": "short SIGSTOPs",
    "corrupt": "damaged messages on", "replay": "old messages on", "drop": "what is held slips",
}

_WEIGHTS: dict[Kind, float] = {
    "kill": 6, "restart": 2, "freeze": 4, "delay": 2, "corrupt": 5, "replay": 2, "drop": 3,
}


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        at: when [s, wall time] from the cell being up.
        kind: kill -9, SIGTERM, SIGSTOP for a time, short stops in a row, damaged messages, old messages, an object
            that slips out of the fingers.
        target: name of the process, or key without the cell; empty for an object.
        seconds: how long it lasts, where it lasts; infinite for what stays stopped.
        form: of damaged messages.
        count: messages, or stops in a row.
        seed: of everything else that is random about it.
        holding: whether it waits for an object in the hand.
    """

    at: float
    kind: Kind
    target: str = ""
    seconds: float = 0.0
    form: Form = ""
    count: int = 1
    seed: int = 0
    holding: bool = False

    @property
    def detail(self) -> str:
        """How it is done, for people: "2.1 s", "12 truncated"; may be empty."""
        match self.kind:
            case "freeze":
                text = f"{self.seconds:.1f} s" if math.isfinite(self.seconds) else "until it is noticed"
            case "delay":
                text = f"{self.count} x {self.seconds:.2f} s"
            case "corrupt":
                text = f"{self.count} {self.form}"
            case "replay":
                text = f"{self.count}, {self.seconds:.1f} s late"
            case _:
                text = ""
        return ", ".join(part for part in (text, "something in the hand" if self.holding else "") if part)

    @property
    def what(self) -> str:
        """What is done and how: "kill -9", "SIGSTOP: 2.1 s"."""
        return ": ".join(part for part in (LABELS[self.kind], self.detail) if part)

    def __str__(self) -> str:
        """As "SIGSTOP camera_simulator: 2.1 s"."""
        action = f"{LABELS[self.kind]} {self.target}".rstrip()
        return ": ".join(part for part in (action, self.detail) if part)


def faults(
    seed: int, processes: Sequence[str], keys: Sequence[str], *, objects: bool, per_minute: float = PER_MINUTE
) -> Iterator[Fault]:
    """Faults without end, in order.

    Args:
        seed: of the plan.
        processes: that can be killed and stopped.
        keys: of topics and requests under which bad messages are put.
        objects: whether there is something that can slip out of a hand.
        per_minute: of wall time, on average.
    """
    rng = np.random.default_rng(seed)
    kinds = [kind for kind in get_args(Kind) if objects or kind != "drop"]
    weights = np.array([_WEIGHTS[kind] for kind in kinds])
    mean = max(60.0 / per_minute - LEAST_GAP, 0.01)
    at = 0.0
    while True:
        at += LEAST_GAP + min(float(rng.exponential(mean)), 3 * mean)
        kind: Kind = rng.choice(kinds, p=weights / weights.sum())
        yield _fault(at, kind, rng, processes, keys, objects)


def plan(
    seed: int, processes: Sequence[str], keys: Sequence[str], *, objects: bool, seconds: float,
    per_minute: float = PER_MINUTE,
) -> list[Fault]:
    """The faults of the first `seconds` [s, wall time]; see `faults`."""
    endless = faults(seed, processes, keys, objects=objects, per_minute=per_minute)
    return list(takewhile(lambda fault: fault.at <= seconds, endless))


def _fault(
    at: float, kind: Kind, rng: np.random.Generator, processes: Sequence[str], keys: Sequence[str], objects: bool
) -> Fault:
    seed, at = int(rng.integers(2**31)), round(at, 3)
    process, key = str(rng.choice(processes)), str(rng.choice(keys))
    holding = objects and bool(rng.random() < HOLDING)
    if kind in ("kill", "restart"):
        return Fault(at, kind, process, seed=seed, holding=holding)
    if kind == "freeze":
        seconds = math.inf if rng.random() < LEFT_STOPPED else round(float(rng.uniform(0.3, 6.0)), 2)
        return Fault(at, kind, process, seconds, seed=seed, holding=holding)
    if kind == "delay":
        seconds = round(float(rng.uniform(0.05, 0.5)), 2)
        return Fault(at, kind, process, seconds, count=int(rng.integers(2, 6)), seed=seed)
    if kind == "corrupt":
        form: Form = rng.choice([form for form in get_args(Form) if form])
        count = 1 if form == "huge" else int(rng.integers(3, 40))
        return Fault(at, kind, key, form=form, count=count, seed=seed)
    if kind == "replay":
        seconds = round(float(rng.uniform(0.5, 3.0)), 2)
        return Fault(at, kind, key, seconds, count=int(rng.integers(1, 20)), seed=seed)
    return Fault(at, kind, seed=seed)


CLEARANCE = 0.12  # [m] from the container's edge: what falls between its wall and this may be hidden by it
FALLS_STRAIGHT = "kinematic"  # the world in which what is let go has no speed
RECENT = 0.1  # [s] between what is compared to find how fast the hand goes
FARTHER = (0.0, 1.0, 1.5)  # as far as it rolls by what was known, and half as far again: the hand may go on speeding up

Place = tuple[float, float]
Seen = tuple[str, int, tuple[float, float, float]]  # what is held, when [ns] and where [m]


class SlipGate:
    """Watches what is held, for how fast it goes."""

    def __init__(self, world: World) -> None:
        """Start with nothing in the hand."""
        self._world = world
        self._newest: Seen | None = None
        self._velocity: Place | None = None  # [m/s] once two pictures of it are known

    def may(self, objects: WorldObjects | None) -> bool:
        """Whether what is held would come to rest in sight and clear of walls, or fall into a container as it hangs."""
        held = next((thing for thing in objects.objects if thing.state == "held"), None) if objects else None
        if objects is None or held is None:
            self._newest = self._velocity = None
            return False
        self._note(held, objects.header.stamp)
        x, y, z = _place(held)
        if self._world.simulator == FALLS_STRAIGHT:
            return self._is_clear((x, y))
        if self._velocity is None:
            return False
        dx, dy = thrown(self._velocity, max(z - self._world.table_height, 0.0), _radius(held))
        return all(self._is_clear(place) and self._is_seen(place, _radius(held))
                   for place in [(x + dx * far, y + dy * far) for far in FARTHER])

    def _note(self, held: WorldObject, stamp: int) -> None:
        before, now = self._newest, (held.id, stamp, _place(held))
        if before is None or before[0] != held.id or stamp < before[1]:
            self._velocity = None
        elif stamp > before[1]:
            seconds = (stamp - before[1]) * 1e-9
            way = now[2][0] - before[2][0], now[2][1] - before[2][1]
            self._velocity = (way[0] / seconds, way[1] / seconds) if seconds <= RECENT else None
        self._newest = now

    def _is_clear(self, place: Place) -> bool:
        off = [(max(abs(place[0] - box.x), abs(place[1] - box.y)) - box.half_side, box.wall_thickness)
               for box in self._world.containers.values()]
        return all(far > CLEARANCE or far < -wall for far, wall in off)

    def _is_seen(self, place: Place, radius: float) -> bool:
        return any(sphere_in_image(camera, place, self._world.table_height + radius, radius)
                   for camera in self._world.cameras.values())


def thrown(velocity: Place, height: float, radius: float) -> Place:
    """How far [m] a sphere gets that is let go at a velocity [m/s] and a height [m], before it has stopped rolling.

    It flies for sqrt(2 h / g), and comes to roll with 5/7 of its speed (that of a solid sphere which did not turn),
    which rolling friction takes at (5/7) g c / r.
    """
    speed = math.hypot(*velocity)
    slows = 5 / 7 * GRAVITY * ROLLING / radius
    seconds = math.sqrt(2 * max(height - radius, 0.0) / GRAVITY) + (5 / 7) ** 2 * speed / (2 * slows)
    return velocity[0] * seconds, velocity[1] * seconds


def _place(thing: WorldObject) -> tuple[float, float, float]:
    return thing.pose.position.x, thing.pose.position.y, thing.pose.position.z


def _radius(thing: WorldObject) -> float:
    return max(thing.size.x, thing.size.y, thing.size.z, 1e-3) / 2
