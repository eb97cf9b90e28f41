"""Kinematic world: the ground truth of a simulated cell, read by cameras and never by decision logic.

Simulates grasping, carrying, falling and coming to rest, but no pushing and no rolling: a body that cannot stay where
it falls is moved to the nearest position where it can.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig, ObjectConfig, Scenery, SuctionCup, Surroundings, World
from common.errors import ConfigError, Refused, UnknownName
from common.messages import Header, WorldEdit, WorldObject, WorldObjects
from common.robot.transforms import invert, transform
from common.sim.bodies import Body, Rest, WorldEvents, pressed_ends, restored
from common.sim.conveyors import Belts, carried
from common.sim.hands import Hand, HandInWorld
from common.sim.interface import GraspTolerances, ObjectSnapshot
from common.sim.layout import new_body, requested_position, require_room
from common.sim.objects import initial_pose, solid_of, solid_of_message
from common.sim.resting import Ground
from common.sim.suction import GRAVITY, NOTHING, seal_problem, weight_problem

if TYPE_CHECKING:
    from common.perception.pinhole import Pinhole
    from common.robot.model import RobotModel
    from common.sim.rendering import Renderer

Array = NDArray[np.float64]

FEW = 32  # spheres for which a search is fast


def create(
    world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances, gripper: GripperConfig | None
) -> KinematicWorld:
    """Create the world with objects that all have a position."""
    return KinematicWorld(world, objects, tolerances, gripper)


def renderer(
    around: Surroundings, scenery: Scenery, robots: Callable[[], Sequence[RobotModel]], *, plain: bool, camera: Pinhole,
    arm: bool = False,
) -> Renderer:
    """Create the renderer of this world for one camera: see `common.sim.interface`."""
    from common.sim.rendering import Renderer  # only cameras need it

    seen = robots() if arm or not plain else ()
    return Renderer(around, *seen, plain=plain, camera=camera, scenery=scenery)


class KinematicWorld(WorldEvents):
    """The objects, and their motion as the gripper moves among them.

    Attributes:
        version: increases with every change.
        no_seal: why a suction cup does not seal on anything, by the newest `obstruction`; empty if it does.
        belts: carry what lies on them.
    """

    def __init__(
        self, world: World, objects: Sequence[ObjectConfig] | None = None, tolerances: GraspTolerances | None = None,
        gripper: GripperConfig | None = None,
    ) -> None:
        """Put every object at its initial position; a sphere above a container lies in it.

        Raises:
            ConfigError: an object cannot lie there.
        """
        super().__init__()
        self._config, self.no_seal = world, ""
        self._tolerances = tolerances or GraspTolerances()
        self._hand = Hand("", gripper)
        self._hands = {"": self._hand}
        self._ground, self.belts = Ground(world), Belts(world.conveyors)
        self._first = {obj.id: obj for obj in (world.objects if objects is None else objects)}
        self._solids = {name: solid_of(obj) for name, obj in self._first.items()}
        self._bodies: dict[str, Body] = {}
        try:
            self._lay_out()
        except Refused as refusal:
            raise ConfigError("world.objects", ..., f"cannot be placed: {refusal}") from None
        self._events.clear()

    # --- snapshot ---

    @cached_property
    def layout(self) -> dict[str, tuple[float, ...]]:
        """Initial positions (x, y, z) [m] by id."""
        return {name: tuple(initial_pose(obj, self._solids[name])[:3, 3].tolist())
                for name, obj in self._first.items()}

    def snapshot(self) -> dict[str, ObjectSnapshot]:
        """Complete state, for `restore`."""
        return {name: body.snapshot() for name, body in self._bodies.items()}

    def restore(self, objects: Mapping[str, ObjectSnapshot]) -> None:
        """Restore a state; objects of unknown shape are skipped."""
        self._bodies = {name: body for name, snapshot in objects.items() if (body := self._restored(name, snapshot))}
        self._forget_between()
        self.version += 1

    def _forget_between(self) -> None:
        for hand in self._hands.values():
            hand.between = {}

    def _restored(self, name: str, snapshot: ObjectSnapshot) -> Body | None:
        first = self._first.get(snapshot.like or name)
        if snapshot.definition is not None:
            solid, c = solid_of_message(snapshot.definition), snapshot.definition.color
            color = (c.r, c.g, c.b)
        elif first is not None:
            solid, color = self._solids[first.id], first.color
        else:
            return None
        return restored(name, snapshot, solid, color)

    # --- gripper ---

    def hand(self, arm: str, gripper: GripperConfig | None) -> HandInWorld:
        """Return this world as the gripper of an arm meets it, in a cell with several."""
        self._hands[arm] = Hand(arm, gripper)
        return HandInWorld(self, self._hands[arm])

    def obstruction(self, T_world_tcp: Array, width: float) -> float:
        """Width [m] below which the fingers cannot close: see `common.sim.interface`."""
        return self.obstruction_of(self._hand, T_world_tcp, width)

    def obstruction_of(self, hand: Hand, T_world_tcp: Array, width: float) -> float:
        """Width [m] below which the fingers of one gripper cannot close; remembers what is between them."""
        if held := self.held_by(hand.arm):
            return held.width
        if hand.gripper is not None and hand.gripper.cup is not None:
            return self._seal(hand, T_world_tcp, hand.gripper.cup, hand.gripper.held_width)
        found: dict[str, tuple[float, float]] = {}
        T_world_hand = hand.T = T_world_tcp @ hand.T_tcp_closing
        for name, body in self._bodies.items():
            if body.state in ("table", "contained", "held") and (
                ends := pressed_ends(self._tolerances, body, T_world_hand, width, hand.between.get(name))
            ):
                found[name] = ends
        hand.between = found
        return max((high - low for low, high in found.values()), default=0.0)

    def _seal(self, hand: Hand, T_world_tcp: Array, cup: SuctionCup, width: float) -> float:
        """Return the width [m] of a cup that seals on an object, else 0; note why it does not seal."""
        hand.between, self.no_seal = {}, NOTHING
        hand.T = T_world_tcp @ hand.T_tcp_closing
        for name, body in self._bodies.items():
            if body.state in ("table", "contained", "held"):
                problem = seal_problem(cup, body.solid, invert(T_world_tcp) @ body.T)
                if not (problem := problem or weight_problem(cup, body.mass)):
                    hand.between, self.no_seal = {name: (-width / 2, width / 2)}, ""
                    return width
                if problem != NOTHING:
                    self.no_seal = f"{name}: {problem}"
        return 0.0

    def takes_long(self, width: float, gripping: bool) -> bool:
        """Whether the next `tick` may take longer than a control cycle, since it searches for a rest position."""
        return self.takes_long_for(self._hand, width, gripping)

    def takes_long_for(self, hand: Hand, width: float, gripping: bool) -> bool:
        """Whether the next tick of one gripper may take longer than a control cycle."""
        if self.is_simple:
            return False
        if held := self.held_by(hand.arm):
            return width > held.width + self._tolerances.release
        return gripping and bool(hand.between)

    @property
    def is_simple(self) -> bool:
        """Whether searches for rest positions are fast: few objects, all spheres."""
        return len(self._bodies) <= FEW and all(body.solid.shape == "sphere" for body in self._bodies.values())

    def tick(self, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Advance to a time: see `common.sim.interface`."""
        self.tick_of(self._hand, now, T_world_tcp, width, gripping)

    def tick_of(self, hand: Hand, now: float, T_world_tcp: Array, width: float, gripping: bool) -> None:
        """Advance to a time with one of the grippers."""
        self._convey(now)
        body = self.held_by(hand.arm)
        T_world_hand = hand.T = T_world_tcp @ hand.T_tcp_closing
        pressed = set(hand.between) if gripping else set()
        for other in self._bodies.values():  # it released what another one holds
            if other.second == hand.arm and other.holder != hand.arm and other.name not in pressed:
                other.second = ""
        if body is None and pressed:
            near = min(pressed, key=lambda n: float(np.linalg.norm(self._bodies[n].T[:3, 3] - T_world_tcp[:3, 3])))
            body = self._bodies[near]
            if body.state == "held":
                body.second, body = hand.arm, None
            else:
                self._grasp(body, hand, now)
        if body is not None:
            self.version += body.carry(T_world_hand)
            if width > body.width + self._tolerances.release:
                self._hand_over(body, now)
        for each in self._bodies.values():
            if each.state == "falling":
                self._fall(each, now)

    def _convey(self, now: float) -> None:
        """Move what lies on belts; at their end it falls off, or comes again at their start."""
        moves = self.belts.advance(now)
        if not any(moves.values()):
            return
        for name, (belt, move) in carried(self.belts, moves, self._bodies.values()).items():
            body = self._bodies[name]
            body.T = body.T.copy()
            body.T[:3, 3] += move
            body.changed()
            self.version += 1
            way, length = belt.config.along(float(body.T[0, 3]), float(body.T[1, 3]))[0], belt.config.dimensions[0]
            if not 0 <= way <= length and belt.config.end == "wrap":
                body.T[:2, 3] -= np.array(belt.config.direction) * (length if way > length else -length)
            elif not 0 <= way <= length:
                self._add_event("remove", body)
                self._release(body, now)
        self.belts.update_barriers(self._bodies.values())

    def _hand_over(self, body: Body, now: float) -> None:
        """Hand a body over to the other gripper that presses on it; drop it if there is none."""
        taker = self._hands.get(body.second) if body.second != body.holder else None
        if taker is None or taker.T is None or body.name not in taker.between:
            self._release(body, now)
            return
        taker.take(body)
        self.version += 1

    def _grasp(self, body: Body, hand: Hand, now: float) -> None:
        assert hand.T is not None
        low, high = hand.between[body.name]
        body.grip = invert(hand.T) @ body.T
        body.grip[1, 3] -= (low + high) / 2  # the fingers center it
        has_cup = hand.gripper is not None and hand.gripper.cup is not None
        body.width = 2 * body.solid.radius if body.solid.shape == "sphere" and not has_cup else high - low
        slot, block = body.slot_taken, body.block()
        body.state, body.container, body.slot, body.holder = "held", "", None, hand.arm
        body.changed()
        hand.between = {}
        self._add_event("remove", body)
        self._lower_layers(slot, now)
        self._drop_bodies_above(block, now)

    def _release(self, body: Body, now: float) -> None:
        body.rest = self._ground.below(body, self._bodies)
        self._drop(body, now)

    def _drop(self, body: Body, now: float) -> None:
        body.state, body.grip, body.drop_height, body.drop_time = "falling", None, float(body.T[2, 3]), now
        body.container, body.slot, body.holder, body.second = "", None, "", ""
        body.changed()
        self.version += 1

    def _fall(self, body: Body, now: float) -> None:
        assert body.rest is not None
        self.version += 1
        z = body.drop_height - GRAVITY * (now - body.drop_time) ** 2 / 2
        if z > body.rest.T[2, 3]:
            body.T = transform(body.T[:3, :3], (float(body.T[0, 3]), float(body.T[1, 3]), z))
            body.changed()
            return
        body.rest_at(body.rest)
        if body.state != "elsewhere":
            self._add_event("add", body)

    def _lower_layers(self, taken: tuple[str, tuple[int, int]] | None, now: float) -> None:
        """Let the spheres above a slot that was vacated fall by one layer."""
        if taken is None:
            return
        container, (layer, index) = taken
        for body in self._bodies.values():
            mine = body.slot_taken
            if mine is not None and mine[0] == container and mine[1][1] == index and mine[1][0] > layer:
                slot = (mine[1][0] - 1, index)
                position = self._ground.slot_position(container, body.solid.radius, slot)
                settled = body.state == "contained"
                body.rest = Rest(transform(body.T[:3, :3], position), "contained", container, slot)
                body.changed()
                if settled:
                    self._add_event("remove", body)
                    self._drop(body, now)

    def _drop_bodies_above(self, gone: Any, now: float) -> None:
        """Let the bodies fall that lay on a body that is gone."""
        for body in self._ground.unsupported_by(gone, self._bodies):
            block = body.block()
            self._add_event("remove", body)
            self._release(body, now)
            self._drop_bodies_above(block, now)

    # --- edits ---

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Whether an edit may take longer than a control cycle."""
        return not self.is_simple or request.shape not in (None, "sphere") or any(
            solid.shape != "sphere" for solid in self._solids.values())

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as an operator requests: see `common.sim.interface`."""
        if request.op == "reset":
            return self._reset()
        name = request.id
        if request.op == "drop":
            return self._slip(name, now)
        old = self._bodies.get(name)
        if request.op == "add":
            body = new_body(request, self._first, self._solids, self._config.spare, self._bodies)
            require_room((each.solid for each in (*self._bodies.values(), body)), len(self._bodies))
        elif old is None:
            raise Refused("unknown_id", str(UnknownName("object", name, list(self._bodies))))
        else:
            body = old
        rest = None
        if request.op != "remove":
            at = requested_position(request)
            rest = self._ground.put(body, at.x, at.y, request.yaw, self._bodies)
        rested, slot = old is not None and old.state in ("table", "contained"), body.slot_taken
        block = body.block() if rested else None
        if rested:
            self._add_event("remove", body)
        if rest is not None:
            body.rest_at(rest)
            self._bodies[body.name] = body
            self._add_event("add", body)
        else:
            del self._bodies[name]
        for hand in self._hands.values():
            hand.between.pop(body.name, None)
        if body.slot_taken != slot or rest is None:
            self._lower_layers(slot, now)
        if block is not None:
            self._drop_bodies_above(block, now)
        self.version += 1
        return body.name

    def _slip(self, name: str, now: float) -> str:
        """Let the held body slip out of the fingers, which close; return its id. Raises Refused if nothing is held."""
        held = name if name in self._bodies and self._bodies[name].state == "held" else "" if name else self.held
        if not held:
            raise Refused("not_held", f"{name or 'nothing'} is {'not ' if name else ''}between the fingers")
        self._release(self._bodies[held], now)
        return held

    def _reset(self) -> str:
        for body in self._bodies.values():
            if body.state in ("table", "contained"):
                self._add_event("remove", body)
        self._bodies = {}
        self._forget_between()
        self._lay_out()
        return ""

    def _lay_out(self) -> None:
        for name, obj in self._first.items():
            solid = self._solids[name]
            body = Body(name, solid, obj.color, initial_pose(obj, solid), mass=obj.mass)
            if solid.shape == "sphere" and obj.x is not None and obj.y is not None and (
                obj.z == self._config.table_height
            ):
                body.rest_at(self._ground.put(body, obj.x, obj.y, None, self._bodies))
            elif container := self._ground.container_of(body):
                body.rest_at(Rest(body.T, "contained", container))
            self._bodies[name] = body
            self._add_event("add", body)

    # --- queries ---

    @property
    def ids(self) -> list[str]:
        """Ids of all objects."""
        return list(self._bodies)

    @property
    def bodies(self) -> dict[str, Body]:
        """All bodies by id, for a world with other dynamics."""
        return self._bodies

    def held_by(self, arm: str) -> Body | None:
        """Return the body that the gripper of an arm holds."""
        return next((body for body in self._bodies.values() if body.state == "held" and body.holder == arm), None)

    @property
    def held(self) -> str:
        """Id of the held object, or an empty string."""
        return next((name for name, body in self._bodies.items() if body.state == "held"), "")

    def objects(self, header: Header) -> WorldObjects:
        """State of all objects; those in state "elsewhere" are off the table and invisible."""
        return WorldObjects(header=header, objects=[body.message() for body in self._bodies.values()])


__all__ = ["GraspTolerances", "KinematicWorld", "WorldObject", "create"]
