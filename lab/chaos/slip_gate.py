"""Decides when a held object may slip: it must come to rest where a camera sees it and the arm can grasp it again."""

from __future__ import annotations

import math

from common.config import World
from common.messages import WorldObject, WorldObjects
from common.sim.layout import sphere_in_image
from common.sim.suction import GRAVITY
from drivers.mujoco import ROLLING

CLEARANCE = 0.12  # [m] from a container's edge: an object between its wall and this may be occluded by the wall
FALLS_STRAIGHT = "kinematic"  # simulator in which a released object has no velocity
RECENT = 0.1  # [s] longest time between two positions from which the velocity is computed
FACTORS = (0.0, 1.0, 1.5)  # of the predicted distance: the gripper may still accelerate

Point = tuple[float, float]  # x, y [m]
Observation = tuple[str, int, tuple[float, float, float]]  # id of the held object, stamp [ns], position [m]


class SlipGate:
    """Tracks the velocity of the held object."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._newest: Observation | None = None
        self._velocity: Point | None = None  # [m/s] after two observations

    def may(self, objects: WorldObjects | None) -> bool:
        """Return whether the held object would come to rest visible and clear of walls, or fall into a container."""
        held = next((each for each in objects.objects if each.state == "held"), None) if objects else None
        if objects is None or held is None:
            self._newest = self._velocity = None
            return False
        self._observe(held, objects.header.stamp)
        x, y, z = _position(held)
        if self._world.simulator == FALLS_STRAIGHT:
            return self._is_clear((x, y))
        if self._velocity is None:
            return False
        dx, dy = thrown(self._velocity, max(z - self._world.table_height, 0.0), _radius(held))
        return all(self._is_clear(point) and self._is_visible(point, _radius(held))
                   for point in [(x + dx * factor, y + dy * factor) for factor in FACTORS])

    def _observe(self, held: WorldObject, stamp: int) -> None:
        before, now = self._newest, (held.id, stamp, _position(held))
        if before is None or before[0] != held.id or stamp < before[1]:
            self._velocity = None
        elif stamp > before[1]:
            seconds = (stamp - before[1]) * 1e-9
            dx, dy = now[2][0] - before[2][0], now[2][1] - before[2][1]
            self._velocity = (dx / seconds, dy / seconds) if seconds <= RECENT else None
        self._newest = now

    def _is_clear(self, point: Point) -> bool:
        distances = [(max(abs(point[0] - box.x), abs(point[1] - box.y)) - box.half_side, box.wall_thickness)
                     for box in self._world.containers.values()]
        return all(distance > CLEARANCE or distance < -wall for distance, wall in distances)

    def _is_visible(self, point: Point, radius: float) -> bool:
        return any(sphere_in_image(camera, point, self._world.table_height + radius, radius)
                   for camera in self._world.cameras.values())


def thrown(velocity: Point, height: float, radius: float) -> Point:
    """Return how far [m] a sphere travels that is released at a velocity [m/s] and height [m], until it stops rolling.

    It falls for sqrt(2 h / g). After the impact it rolls with 5/7 of its speed (a solid sphere without spin), which
    rolling friction reduces by (5/7) g c / r.
    """
    speed = math.hypot(*velocity)
    deceleration = 5 / 7 * GRAVITY * ROLLING / radius
    seconds = math.sqrt(2 * max(height - radius, 0.0) / GRAVITY) + (5 / 7) ** 2 * speed / (2 * deceleration)
    return velocity[0] * seconds, velocity[1] * seconds


def _position(item: WorldObject) -> tuple[float, float, float]:
    return item.pose.position.x, item.pose.position.y, item.pose.position.z


def _radius(item: WorldObject) -> float:
    return max(item.size.x, item.size.y, item.size.z, 1e-3) / 2
