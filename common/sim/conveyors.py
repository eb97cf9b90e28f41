"""Simulated conveyor belts: their drive, encoder and light barrier, and what they do to objects at their end."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from common.config import Conveyor
from common.errors import Refused, UnknownName
from common.messages import BeltState, ConveyorSet, ConveyorState, Header
from common.sim.bodies import Body

Array = NDArray[np.float64]

PERIOD = 0.02  # [s] cell time between reports of a moving belt
LONGEST = 0.5  # [s] between two steps: time of a longer gap is skipped


class Belt:
    """One belt. Positions are along it [m].

    Attributes:
        position: of the surface since the start, as an encoder measures it.
        speed: [m/s].
        running: whether it is switched on.
        set_speed: speed while it runs [m/s].
        blocked: whether something is in the light barrier.
    """

    def __init__(self, config: Conveyor) -> None:
        """Start as configured, at full speed if it runs."""
        self.config, self.position, self.running, self.set_speed = config, 0.0, config.running, config.speed
        self.speed, self.blocked = config.speed if config.running else 0.0, False

    def advance(self, seconds: float) -> float:
        """Advance by a time [s]; return how far the surface moves [m]."""
        waits = self.config.end == "stop" and self.blocked
        target = self.set_speed if self.running and not waits else 0.0
        change = self.config.acceleration * seconds
        before, self.speed = self.speed, min(max(target, self.speed - change), self.speed + change)
        moved = seconds * (before + self.speed) / 2
        self.position += moved
        return moved

    def meets_barrier(self, body: Body) -> bool:
        """Return whether a body on the belt is in the light barrier."""
        c, barrier = self.config, self.config.barrier
        x, y = float(body.T[0, 3]), float(body.T[1, 3])
        if barrier is None or not c.carries(x, y, body.bottom):
            return False
        along = body.solid.footprint(body.T[:3, :3]) @ np.array(c.direction) + c.along(x, y)[0]
        return bool(along.min() <= barrier <= along.max())


class Belts:
    """All belts of a world."""

    def __init__(self, conveyors: Mapping[str, Conveyor]) -> None:
        """Start all as configured."""
        self.by_name = {name: Belt(config) for name, config in conveyors.items()}
        self._time: float | None = None
        self._stopped = 0  # `since` of the newest STOP that was applied
        self._published: tuple[list[BeltState], float] = ([], -math.inf)

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self.by_name)

    def advance(self, now: float) -> dict[str, float]:
        """Advance to a cell time [s]; return how far each surface moves [m]."""
        seconds = 0.0 if self._time is None else now - self._time
        self._time = now
        return {name: belt.advance(seconds if 0 <= seconds <= LONGEST else 0.0) for name, belt in self.by_name.items()}

    def update_barriers(self, bodies: Iterable[Body]) -> None:
        """Let the light barriers see the bodies that are not held."""
        resting = [body for body in bodies if body.state == "table"]
        for belt in self.by_name.values():
            if belt.config.barrier is not None:
                belt.blocked = any(belt.meets_barrier(body) for body in resting)

    def set(self, request: ConveyorSet) -> None:
        """Start or stop a belt, or change its speed.

        Raises:
            Refused: no such belt, or it is not that fast.
        """
        name = request.name or (next(iter(self.by_name)) if len(self.by_name) == 1 else "")
        if name not in self.by_name:
            raise Refused("unknown_belt", str(UnknownName("conveyor", name, self.by_name)))
        belt = self.by_name[name]
        if request.speed is not None:
            if abs(request.speed) > belt.config.max_speed:
                raise Refused("bad_value", f"speed {request.speed:g} m/s of {name} is more than its max_speed, "
                                           f"{belt.config.max_speed:g} m/s")
            belt.set_speed = request.speed
        if request.running is not None:
            belt.running = request.running

    def apply_stop(self, since: int) -> None:
        """Switch off the belts that a STOP stops; `since` is the time of the newest STOP in force, 0 for none."""
        if since <= self._stopped:
            return
        self._stopped = since
        for belt in self.by_name.values():
            belt.running = belt.running and belt.config.on_stop == "run"

    def state(self, header: Header) -> ConveyorState:
        """Return the state of all belts."""
        return ConveyorState(header=header, belts=[
            BeltState(name=name, position=belt.position, speed=belt.speed, running=belt.running,
                      set_speed=belt.set_speed, blocked=belt.blocked) for name, belt in self.by_name.items()])

    def changed(self, header: Header) -> ConveyorState | None:
        """Return the state if it has changed and it is time to publish it."""
        now = header.stamp * 1e-9
        if not self.by_name or now - self._published[1] < PERIOD - 1e-6:
            return None
        state = self.state(header)
        if state.belts == self._published[0]:
            return None
        self._published = state.belts, now
        return state


def carried(belts: Belts, moves: Mapping[str, float], bodies: Iterable[Body]) -> dict[str, tuple[Belt, Array]]:
    """Return the belt below each body that is on one, also on top of another body, and its displacement (3,) [m]."""
    found: dict[str, tuple[Belt, Array]] = {}
    below: list[Body] = []
    for body in sorted((body for body in bodies if body.state == "table"), key=lambda body: body.bottom):
        x, y, bottom = float(body.T[0, 3]), float(body.T[1, 3]), body.bottom
        for name, belt in belts.by_name.items():
            if belt.config.carries(x, y, bottom):
                found[body.name] = belt, moves[name] * np.array([*belt.config.direction, 0.0])
        if body.name not in found:
            carrier = next((other for other in below if abs(other.bottom + other.solid.size[2] - bottom) < 2e-3
                            and math.dist((x, y), other.T[:2, 3]) < other.solid.reach), None)
            if carrier is not None:
                found[body.name] = found[carrier.name]
        if body.name in found:
            below.append(body)
    return found
