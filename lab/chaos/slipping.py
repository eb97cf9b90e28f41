"""When what is in the hand may be let slip: where it comes to rest it has to be seen, and can be taken again."""

from __future__ import annotations

import math

from common.config import World
from common.messages import WorldObject, WorldObjects
from common.sim.kinematic import GRAVITY
from common.sim.layout import sphere_in_image
from drivers.mujoco.scene import ROLLING

CLEARANCE = 0.12  # [m] from the container's edge: what falls between its wall and this may be hidden by it
FALLS_STRAIGHT = "kinematic"  # the world in which what is let go has no speed
RECENT = 0.1  # [s] between what is compared to find how fast the hand goes
FARTHER = (0.0, 1.0, 1.5)  # as far as it rolls by what was known, and half as far again: the hand may go on speeding up

Place = tuple[float, float]
Seen = tuple[str, int, tuple[float, float, float]]  # what is held, when [ns] and where [m]


class Slipping:
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
