"""The truth beside simulated hardware: where everything really is. Read by cameras, by nothing that decides.

Grasping, carrying, falling and coming to rest are simulated; pushing a thing aside, and rolling, are not: what cannot
stay where it falls appears at the nearest place where it can.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig, ObjectConfig, Scenery, Surroundings, World
from common.errors import ConfigError, Refused, UnknownName
from common.messages import Header, WorldEdit, WorldObject, WorldObjects
from common.planning.prism import convex_hull
from common.robot.finger_joints import closing_frame
from common.robot.transforms import invert, transform
from common.sim.bodies import Body, Rest, restored
from common.sim.footprints import is_convex
from common.sim.gripping import felt
from common.sim.interface import GraspTolerances, StandingObject
from common.sim.news import News
from common.sim.objects import Solid, initial_pose, make_solid, solid_of, solid_of_message
from common.sim.resting import Ground

if TYPE_CHECKING:
    from common.perception.pinhole import Pinhole
    from common.robot.model import RobotModel
    from common.sim.rendering import Renderer

Array = NDArray[np.float64]

GRAVITY = 9.81  # [m/s^2]
MOST_OBJECTS = 500  # in the world: each is told of while something moves, and looked at in every cycle
MOST_CORNERS = 50_000  # of all of them
FARTHEST = 1000.0  # [m] along each axis from the origin of world, and from a thing's own: all has to be told of
MOST_BENT = 200  # corners of a cross-section that is not convex: how it meets another takes time by their product
FEW = 32  # spheres among which a place is found at once


def create(
    world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances, gripper: GripperConfig | None
) -> KinematicWorld:
    """The world with its objects, each of which has a place."""
    return KinematicWorld(world, objects, tolerances, gripper)


def renderer(
    around: Surroundings, scenery: Scenery, robot: Callable[[], RobotModel], *, plain: bool, camera: Pinhole,
    arm: bool = False,
) -> Renderer:
    """What draws this world for a camera: see `common.sim.interface`."""
    from common.sim.rendering import Renderer  # of no use to who moves the world

    seen = robot() if arm or not plain else None
    return Renderer(around, seen, plain=plain, camera=camera, scenery=scenery)


class KinematicWorld(News):
    """The objects, and what becomes of them while a hand moves among them.

    Attributes:
        version: grows whenever something has changed.
    """

    def __init__(
        self, world: World, objects: Sequence[ObjectConfig] | None = None, tolerances: GraspTolerances | None = None,
        gripper: GripperConfig | None = None,
    ) -> None:
        """Put every object where it lies at first; a sphere above a container lies in it.

        Raises:
            ConfigError: an object cannot lie where it is to.
        """
        super().__init__()
        self._config = world
        self._tolerances = tolerances or GraspTolerances()
        self._gripper = gripper
        self._T_tcp_closing = closing_frame(gripper) if gripper else np.eye(4)
        self._ground = Ground(world)
        self._first = {thing.id: thing for thing in (world.objects if objects is None else objects)}
        self._solids = {name: solid_of(thing) for name, thing in self._first.items()}
        self._bodies: dict[str, Body] = {}
        self._between: dict[str, tuple[float, float]] = {}  # what the fingers would press on: its ends along tool y [m]
        try:
            self._lay_out()
        except Refused as refusal:
            raise ConfigError("world.objects", ..., f"cannot be laid out: {refusal}") from None
        self._events.clear()

    # --- over a restart ---

    @cached_property
    def layout(self) -> dict[str, tuple[float, ...]]:
        """Where everything was at first, (x, y, z) [m] by id."""
        return {name: tuple(initial_pose(thing, self._solids[name])[:3, 3].tolist())
                for name, thing in self._first.items()}

    def standing(self) -> dict[str, StandingObject]:
        """Everything as it is, for `restore`."""
        return {name: body.standing() for name, body in self._bodies.items()}

    def restore(self, objects: Mapping[str, StandingObject]) -> None:
        """Put everything where it was; what is of a shape that there is not is passed over."""
        self._bodies = {name: body for name, kept in objects.items() if (body := self._restored(name, kept))}
        self._between = {}
        self.version += 1

    def _restored(self, name: str, kept: StandingObject) -> Body | None:
        first = self._first.get(kept.like or name)
        if kept.made is not None:
            solid, c = solid_of_message(kept.made), kept.made.color
            color = (c.r, c.g, c.b)
        elif first is not None:
            solid, color = self._solids[first.id], first.color
        else:
            return None
        return restored(name, kept, solid, color)

    # --- the hand ---

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """The width [m] that the fingers cannot close below: see `common.sim.interface`."""
        if held := self.held:
            return self._bodies[held].width
        found: dict[str, tuple[float, float]] = {}
        T_world_hand = T_world_tcp @ self._T_tcp_closing
        for name, body in self._bodies.items():
            if body.state in ("table", "contained") and (
                ends := felt(self._gripper, self._tolerances, body, T_world_hand, width, self._between.get(name))
            ):
                found[name] = ends
        self._between = found
        return max((high - low for low, high in found.values()), default=0.0)

    def takes_long(self, width: float, gripping: bool) -> bool:
        """Whether places have to be looked for in the next tick, which may take longer than a cycle: as of `tick`."""
        if self._is_plain:
            return False
        if held := self.held:
            return width > self._bodies[held].width + self._tolerances.release
        return gripping and bool(self._between)

    @property
    def _is_plain(self) -> bool:
        return len(self._bodies) <= FEW and all(body.solid.shape == "sphere" for body in self._bodies.values())

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Move on to a time: see `common.sim.interface`."""
        held = self.held
        if not held and gripping and self._between:
            held = min(self._between,
                       key=lambda n: float(np.linalg.norm(self._bodies[n].T[:3, 3] - T_world_tcp[:3, 3])))
            self._grasp(self._bodies[held], T_world_tcp @ self._T_tcp_closing, now)
        if held:
            body = self._bodies[held]
            self._carry(body, T_world_tcp @ self._T_tcp_closing)
            if width > body.width + self._tolerances.release:
                self._release(body, now)
        for body in self._bodies.values():
            if body.state == "falling":
                self._fall(body, now)

    def _grasp(self, body: Body, T_world_tcp: Array, now: float) -> None:
        low, high = self._between[body.name]
        body.grip = invert(T_world_tcp) @ body.T
        body.grip[1, 3] -= (low + high) / 2  # the fingers centre it
        is_cupped = self._gripper is not None and self._gripper.cup is not None
        body.width = 2 * body.solid.radius if body.solid.shape == "sphere" and not is_cupped else high - low
        slot, block = body.slot_taken, body.block()
        body.state, body.container, body.slot = "held", "", None
        body.changed()
        self._between = {}
        self._say("remove", body)
        self._sink(slot, now)
        self._lose(block, now)

    def _carry(self, body: Body, T_world_tcp: Array) -> None:
        assert body.grip is not None
        T = T_world_tcp @ body.grip
        if body.solid.shape == "sphere":
            T[:3, :3] = body.T[:3, :3]
        if not np.array_equal(T, body.T):
            body.T = T
            body.changed()
            self.version += 1

    def _release(self, body: Body, now: float) -> None:
        body.rest = self._ground.below(body, self._bodies)
        self._drop(body, now)

    def _drop(self, body: Body, now: float) -> None:
        body.state, body.grip, body.dropped, body.since = "falling", None, float(body.T[2, 3]), now
        body.container, body.slot = "", None
        body.changed()
        self.version += 1

    def _fall(self, body: Body, now: float) -> None:
        assert body.rest is not None
        self.version += 1
        z = body.dropped - GRAVITY * (now - body.since) ** 2 / 2
        if z > body.rest.T[2, 3]:
            body.T = transform(body.T[:3, :3], (float(body.T[0, 3]), float(body.T[1, 3]), z))
            body.changed()
            return
        body.lie(body.rest)
        if body.state != "elsewhere":
            self._say("add", body)

    def _sink(self, taken: tuple[str, tuple[int, int]] | None, now: float) -> None:
        """Let the spheres above a slot that was vacated fall by one layer."""
        if taken is None:
            return
        container, (layer, index) = taken
        for body in self._bodies.values():
            mine = body.slot_taken
            if mine is not None and mine[0] == container and mine[1][1] == index and mine[1][0] > layer:
                slot = (mine[1][0] - 1, index)
                position = self._ground.slot_position(container, body.solid.radius, slot)
                lies = body.state == "contained"
                body.rest = Rest(transform(body.T[:3, :3], position), "contained", container, slot)
                body.changed()
                if lies:
                    self._say("remove", body)
                    self._drop(body, now)

    def _lose(self, gone: Any, now: float) -> None:
        """Let what lay on something fall, which is no longer there."""
        for body in self._ground.carries_nothing_any_more(gone, self._bodies):
            block = body.block()
            self._say("remove", body)
            self._release(body, now)
            self._lose(block, now)

    # --- edits ---

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Whether an edit may take longer than a cycle."""
        return not self._is_plain or request.shape not in (None, "sphere") or any(
            solid.shape != "sphere" for solid in self._solids.values())

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as a person asks: see `common.sim.interface`."""
        if request.op == "reset":
            return self._reset()
        name = request.id
        if request.op == "drop":
            return self._slip(name, now)
        old = self._bodies.get(name)
        if request.op == "add":
            body = self._made(request)
            self._require_room(body)
        elif old is None:
            raise Refused("unknown_id", str(UnknownName("object", name, list(self._bodies))))
        else:
            body = old
        rest = None
        if request.op != "remove":
            if request.position is None:
                raise Refused("no_position", f"position: {request.op} needs one, for example {{x: 0.5, y: 0.0}}")
            at = request.position
            if max(abs(at.x), abs(at.y), abs(at.z)) > FARTHEST:
                raise Refused("too_far", f"position: is more than {FARTHEST:g} m away from the origin of world")
            rest = self._ground.put(body, request.position.x, request.position.y, request.yaw, self._bodies)
        lay, slot = old is not None and old.state in ("table", "contained"), body.slot_taken
        block = body.block() if lay else None
        if lay:
            self._say("remove", body)
        if rest is not None:
            body.lie(rest)
            self._bodies[body.name] = body
            self._say("add", body)
        else:
            del self._bodies[name]
        self._between.pop(body.name, None)
        if body.slot_taken != slot or rest is None:
            self._sink(slot, now)
        if block is not None:
            self._lose(block, now)
        self.version += 1
        return body.name

    def _made(self, request: WorldEdit) -> Body:
        """What a request adds, nowhere yet."""
        model = self._first.get(request.like) if request.like else self._config.spare
        if model is None:
            raise Refused("unknown_id", str(UnknownName("object of the first layout", request.like, self._first)))
        name = request.id or self._free_name(request.shape or re.sub(r"_\d+$", "", model.id))
        if name in self._bodies:
            raise Refused("id_exists", f"id: {name!r} exists already; leave it empty for a new one")
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,60}", name):
            raise Refused("bad_id", f"id: {name[:60]!r} must be letters, digits, '_', '.' and '-', at most 60")
        c = request.color
        color = model.color if c is None else (c.r, c.g, c.b)
        if request.shape is None:
            solid = self._solids.get(model.id) or solid_of(model)
            like = model.id if model.id in self._first and c is None else ""
        else:
            solid, like = _requested(request), ""
        return Body(name, solid, color, np.eye(4), "elsewhere", added=True, like=like)

    def _require_room(self, body: Body) -> None:
        if len(self._bodies) >= MOST_OBJECTS:
            raise Refused("world_full", f"there are {len(self._bodies)} objects, and room for {MOST_OBJECTS}")
        corners = sum(_corners(each.solid) for each in (*self._bodies.values(), body))
        if corners > MOST_CORNERS:
            raise Refused("world_full", f"all objects together would have {corners} corners; at most {MOST_CORNERS} "
                                        "can be told of")

    def _free_name(self, kind: str) -> str:
        return next(n for i in range(1, len(self._bodies) + 2) if (n := f"{kind}_{i}") not in self._bodies)

    def _slip(self, name: str, now: float) -> str:
        """Let what is held slip out of the fingers, which close on without it; its id. Raises Refused without one."""
        held = self.held
        if not held or name not in ("", held):
            raise Refused("not_held", f"{name or 'nothing'} is {'not ' if name else ''}between the fingers")
        self._release(self._bodies[held], now)
        return held

    def _reset(self) -> str:
        for body in self._bodies.values():
            if body.state in ("table", "contained"):
                self._say("remove", body)
        self._bodies, self._between = {}, {}
        self._lay_out()
        return ""

    def _lay_out(self) -> None:
        for name, thing in self._first.items():
            solid = self._solids[name]
            body = Body(name, solid, thing.color, initial_pose(thing, solid))
            if solid.shape == "sphere" and thing.x is not None and thing.y is not None and (
                thing.z == self._config.table_height
            ):
                body.lie(self._ground.put(body, thing.x, thing.y, None, self._bodies))
            elif container := self._ground.container_of(body):
                body.lie(Rest(body.T, "contained", container))
            self._bodies[name] = body
            self._say("add", body)

    # --- what there is ---

    @property
    def ids(self) -> list[str]:
        """What is in it."""
        return list(self._bodies)

    @property
    def bodies(self) -> dict[str, Body]:
        """Everything by id, for a world that moves it by other laws."""
        return self._bodies

    @property
    def held(self) -> str:
        """The id of what is between the fingers, or an empty string."""
        return next((name for name, body in self._bodies.items() if body.state == "held"), "")

    def objects(self, header: Header) -> WorldObjects:
        """Where everything is; what is "elsewhere" is off the table, out of sight."""
        return WorldObjects(header=header, objects=[body.message() for body in self._bodies.values()])



def _requested(request: WorldEdit) -> Solid:
    """The shape that a request describes. Raises Refused when something of it is missing."""
    size = request.size
    if request.shape is None or size is None or size.x <= 0 or (request.shape != "sphere" and size.z <= 0):
        raise Refused("no_size", f"size: a {request.shape} needs one, for example {{x: 0.04, y: 0.04, z: 0.04}}")
    inner = (request.inner_radius or 0.0) if request.shape == "ring" else 0.0
    if request.shape == "ring" and not 0 < inner < size.x / 2:
        raise Refused("no_size", f"inner_radius: a ring needs one below {size.x / 2:g} m")
    if request.shape == "box" and size.y <= 0:
        raise Refused("no_size", "size: a box needs x, y and z")
    if request.shape == "prism" and len(request.polygon) < 3:
        raise Refused("no_size", "polygon: a prism needs at least 3 corners")
    if len(request.polygon) > MOST_BENT and not is_convex(np.array(request.polygon)):
        raise Refused("too_many_corners", f"polygon: has {len(request.polygon)} corners and is not convex; at most "
                                          f"{MOST_BENT} can be")
    if request.shape == "prism" and len(convex_hull(np.array(request.polygon))) < 3:
        raise Refused("no_size", "polygon: encloses nothing")
    solid = make_solid(request.shape, size, inner, request.polygon)
    if solid.reach > FARTHEST:
        raise Refused("no_size", f"size: it would reach {solid.reach:g} m from its middle; {FARTHEST:g} m can be")
    return solid


def _corners(solid: Solid) -> int:
    return len(solid.section) + len(solid.hole) + 3 * len(solid.mesh)


__all__ = ["GraspTolerances", "KinematicWorld", "WorldObject", "create"]
