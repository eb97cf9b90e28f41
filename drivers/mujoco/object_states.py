"""Object states from physics: contacts, support, grasp, and significant pose changes."""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import World
from common.robot.model import RobotModel
from common.robot.transforms import transform
from common.sim.bodies import Body, State
from common.sim.table import is_inside
from drivers.mujoco.model import CellModel

Array = NDArray[np.float64]

MOVED = 1e-4  # [m] smallest published motion
TURNED = 1e-3  # [rad] smallest published rotation
UPRIGHT = 1 - 1e-6  # cosine of the tilt up to which an object counts as upright
RELEASE_TIME = 0.05  # [s] without finger contact after which an object is released
REST_SPEED = 0.02  # [m/s] of an object at rest


class Contacts:
    """Contacts of objects: with fingers, with the floor, and any."""

    def __init__(self, cell: CellModel, robot: RobotModel) -> None:
        """Start without contacts."""
        model = cell.model
        self._names = list(cell.objects)
        number = {cell.objects[name].body: index for index, name in enumerate(self._names)}
        self._object = np.array([number.get(int(body), -1) for body in model.geom_bodyid])
        config = robot.config.gripper
        fingers = [model.body(link).id for link in (config.links if config is not None else [])]
        side = {body: index for index, body in enumerate(fingers)}
        self._side = np.array([side.get(int(body), -1) for body in model.geom_bodyid])
        self._floor = model.geom("floor").id

    def update(self, data: mujoco.MjData) -> tuple[set[str], set[str], set[str]]:
        """Names of objects touched by two gripper links, on the floor, and touching anything."""
        pairs = data.contact.geom
        if not len(pairs):
            return set(), set(), set()
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        pairs = pairs[self._object[pairs[:, 0]] >= 0]
        objects, others = self._object[pairs[:, 0]], pairs[:, 1]
        sides = self._side[others]
        fingers = np.unique(np.stack([objects[sides >= 0], sides[sides >= 0]]), axis=1)
        names = self._names
        held = {names[index] for index in range(len(names)) if (fingers[0] == index).sum() >= 2}
        return held, {names[index] for index in objects[others == self._floor]}, {names[index] for index in objects}


class ObjectStates:
    """State of each object, in the terms of the kinematic world."""

    def __init__(self, world: World) -> None:
        """Nothing is known yet."""
        self._world = world
        self._touched: dict[str, float] = {}  # by the fingers, when [s]
        self._on_floor: set[str] = set()

    def on_floor(self, name: str) -> None:
        """Mark an object as lying on the floor."""
        self._on_floor.add(name)

    def forget(self, name: str) -> None:
        """Reset an object that an operator moved."""
        self._touched.pop(name, None)
        self._on_floor.discard(name)

    def update(self, now: float, contacts: tuple[set[str], set[str], set[str]], bodies: Mapping[str, Body]) -> None:
        """Update with the contacts at a time [s]."""
        held, floor, _ = contacts
        self._on_floor = (self._on_floor | floor) & bodies.keys()
        for name in held:
            self._touched[name] = now
        self._touched = {name: at for name, at in self._touched.items() if now - at < RELEASE_TIME and name in bodies}

    def state_of(self, body: Body, T: Array, supported: bool) -> tuple[State, str]:
        """State of a body at (4, 4), and the container that holds it."""
        if body.name in self._on_floor:
            return "elsewhere", ""
        if body.name in self._touched:
            return "held", ""
        if not supported:
            return "falling", ""
        x, y, z = (float(value) for value in T[:3, 3])
        top = self._world.table_height + 2 * body.solid.reach
        for container in self._world.containers.values():
            if is_inside(container, x, y) and self._world.table_height < z < top + container.wall_height:
                return "contained", container.id
        return "table", ""


def pose_changed(T: Array, other: Array) -> bool:
    """Whether two poses (4, 4) differ enough to be published."""
    if float(np.abs(T[:3, 3] - other[:3, 3]).max()) > MOVED:
        return True
    cosine = (float(np.sum(T[:3, :3] * other[:3, :3])) - 1) / 2
    return math.acos(min(max(cosine, -1.0), 1.0)) > TURNED


def snap_upright(T: Array) -> Array:
    """Make a nearly upright pose exactly upright: physics tilts standing objects by microns."""
    if not UPRIGHT < T[2, 2] < 1:
        return T
    yaw = math.atan2(T[1, 0], T[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    return transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), (T[0, 3], T[1, 3], T[2, 3]))
