"""What the robot may not touch on its way: the planning scene with the changes that a request asks for."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.errors import UnknownName
from common.messages import CollisionObject, PlanningScene, Pose
from common.planning.constraints import ToolConstraints
from common.planning.kernel.world import EXCUSED, KernelWorld
from common.planning.obstacles import MARGINS, BadShape, ObstacleBank, ObstacleCache, Rules, Solid
from common.planning.path import SmoothPath
from common.planning.points import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.robot.transforms import invert, pose_to_matrix

Array = NDArray[np.float64]
Pair = tuple[str, str]

_PERCEIVED = ("target", "contained", "attached")
_CONTACT_SLACK = 1  # margin level [1 mm] within which an attached object counts as touching at the start
_FARTHEST_HELD = 100.0  # [m] from a joint that what is held may reach
_DEEPER = 2e-4  # [m] than at the start: by rounding, and by how far a followed line may be off


@dataclass(frozen=True)
class Hit:
    """Where along a path the first collision was found, and between what."""

    index: int
    q: Array
    pair: Pair


@dataclass(frozen=True)
class Obstruction:
    """What is in the way: a code for programs, a message for people, and the pair where two things touch."""

    error: str
    message: str
    colliding: Pair | None


class CollisionWorld:
    """Answers whether joint positions, edges and paths are free of collision, for one request on one scene.

    Perceived objects keep `padding` more distance [m]. Three kinds of contact are excused:
    - pairs in the scene's and the request's allowed collisions, always;
    - an attached object with the gripper's links, always;
    - what an attached object touches at the start, and perceived objects into whose padding (not into themselves) a
      link reaches at the start: until the TCP is `contact_distance` away from where it was at the start. Of points,
      their padding alone, for attached objects, too.
    Planners and validation ask the same world, so they hold the same rule. With constraints of the tool, what breaks
    them is not free either (`collides`, `edge_free`, `bends_free`); what touches is told apart from it.
    """

    def __init__(
        self,
        robot: RobotModel,
        scene: PlanningScene,
        *,
        start: ArrayLike,
        padding: float = 0.0,
        allowed: Iterable[Pair] = (),
        attach: str = "",
        attach_pose: Pose | None = None,
        release: bool = False,
        contact_distance: float = 0.02,
        cache: ObstacleCache | None = None,
        constraints: ToolConstraints | None = None,
        points: Sequence[PointObstacle] = (),
        width: float | None = None,
    ) -> None:
        """Set up the scene for a motion that begins at `start` (dof,) [rad].

        Args:
            robot: the model.
            scene: what is to be avoided; its poses are in the base frame.
            start: joint positions at which contact and the pose of the attached object are taken.
            padding: more distance from perceived objects [m].
            allowed: pairs of link or object names that may touch, besides the scene's.
            attach: the only object that moves with the TCP: as in the scene's attached ones, or from where it lies.
            attach_pose: of that object in the TCP frame, when not held yet; else as it lies relative to the start.
            release: nothing is attached.
            contact_distance: travel of the TCP [m] until which contact at the start is excused: of what is held to the
                depth that it has there, of the robot with padding alone.
            cache: built geometry to use again; the world made before with it must not be used any more.
            constraints: what the tool keeps to.
            points: what cameras saw and the scene does not have; kept away from as perceived objects are.
            width: between the fingers [m], the widest where they move on the way; None: as the robot file holds them.

        Raises:
            UnknownName: `attach` is not in the scene.
        """
        self.robot = robot
        self.constraints = constraints
        self.start: Array = np.array(start, dtype=float)
        self.cache = cache or ObstacleCache(RobotGeometry(robot))
        self._T_world_tcp_start = robot.fk(self.start)
        self._origin = self._T_world_tcp_start[:3, 3].copy()
        self.contact_distance = contact_distance
        environment, held = self._sort(scene, attach, attach_pose, release)
        objects = [*environment, *(item for item, _, _ in held)]
        solids = [Solid.of(o) for o in environment]
        solids += [Solid.of(o, robot.model.frames[frame].parentJoint, frame) for o, frame, _ in held]
        self._bank = self.cache.bank(tuple(solids), len(points))
        self._bank.open_fingers(width)
        self._bank.set_points([seen.spheres for seen in points])
        self._bank.place([pose_to_matrix(o.pose) for o in environment] + [pose for _, _, pose in held])
        self._names = [*self.cache.robot.links, *(o.id for o in objects), *(seen.name for seen in points)]
        self._held_from = self._bank.robot_count + len(environment)
        self._points_from = self._held_from + len(held)
        self.attached: list[str] = [o.id for o, _, _ in held]
        padded = np.array(
            [0.0] * self._bank.robot_count
            + [padding if o.role in _PERCEIVED else 0.0 for o in objects]
            + [padding] * len(points)
        )
        margins = padded[self._bank.first] + padded[self._bank.second]
        disabled = self._pairs_named((*scene.allowed_collisions, *allowed))
        self._far = self._bank.far
        self._far.set(disabled, margins)
        self._kernel = self._bank.kernel()
        if self._kernel is not None:
            self._kernel.set_rules(_least(self._far))
            (constraints or ToolConstraints.none(robot)).hand_to(self._kernel)
        self._sunk: Rules | None = None  # what the kernel does not measure: how deep things that touch at the start are
        self._near = self._rules_at_start(disabled, margins)
        self._hand_over_rules()
        self._lever = self._bank.lever
        if held and not self._lever.max() <= _FARTHEST_HELD:  # in pieces of 1 mm there would be no end to its way
            raise BadShape(f"{held[0][0].id}: what is held reaches {self._lever.max():.3g} m from a joint, "
                           f"{_FARTHEST_HELD:g} m are the most")
        # The TCP need not be within the hulls, so it has a lever of its own.
        tcp = robot.model.frames[robot.tcp_frame]
        point = pin.GeometryObject("tcp", tcp.parentJoint, robot.tcp_frame, tcp.placement, coal.Sphere(1e-6))
        self._tcp_lever = self.cache.robot.lever(point)

    def _sort(
        self, scene: PlanningScene, attach: str, attach_pose: Pose | None, release: bool
    ) -> tuple[list[CollisionObject], list[tuple[CollisionObject, int, Array]]]:
        """The environment, and what is held: object, frame, (4, 4) pose in the frame of the joint that carries it."""
        environment = list(scene.objects)
        if release:
            return environment, []
        model = self.robot.model
        held = []
        for item in scene.attached:
            if attach and item.object.id != attach:
                continue  # let go by the time that this one is taken
            if item.link not in self.robot.link_names:
                raise UnknownName("link", item.link, self.robot.link_names)
            frame = model.getFrameId(item.link)
            T_joint_link = model.frames[frame].placement.homogeneous
            held.append((item.object, frame, T_joint_link @ pose_to_matrix(item.object.pose)))
        if attach and attach not in {item.id for item, _, _ in held}:
            found = next((o for o in environment if o.id == attach), None)
            if found is None:
                raise UnknownName("object", attach, [o.id for o in environment] + [item.id for item, _, _ in held])
            frame = self.robot.tcp_frame
            T_joint_tcp = model.frames[frame].placement.homogeneous
            T_tcp_object = invert(self._T_world_tcp_start) @ pose_to_matrix(found.pose)
            if attach_pose is not None:
                T_tcp_object = pose_to_matrix(attach_pose)
            held.append((found, frame, T_joint_tcp @ T_tcp_object))
        names = {item.id for item, _, _ in held}
        return [o for o in environment if o.id not in names], held

    def _hand_over_rules(self) -> None:
        """Tell the kernel what counts, and where."""
        if self._kernel is None or self._near is self._far:
            return
        tool = self.robot.model.frames[self.robot.tcp_frame]
        self._kernel.set_rules(
            _least(self._far), _least(self._near), tool.parentJoint, np.array(tool.placement.translation), self._origin,
            self.contact_distance,
        )

    def _close_at_start(self, level: int) -> list[int]:
        """Pairs that are closer at the start than they may be, with the level's margin on top."""
        if self._kernel is None:
            return self._far.pairs(self.start, level) if self._far.hit(self.start, level) else []
        least = _least(self._far)
        more = np.where(least > EXCUSED, MARGINS[level] * self._bank.shares, 0.0)
        return np.flatnonzero(self._kernel.distances(self.start)[0] <= least + more).tolist()

    def _rules_at_start(self, disabled: frozenset[int], margins: Array) -> Rules:
        """Rules while the TCP is near its start: the far ones, but for what is excused there."""
        close = self._close_at_start(_CONTACT_SLACK)
        if not close:
            return self._far
        first, second = self._bank.first, self._bank.second
        last = np.maximum(first, second)
        touching = [i for i in close if self._held_from <= last[i] < self._points_from]
        near_margins = margins.copy()
        near_margins[self._close_at_start(0)] = 0.0
        near_margins[touching] = np.minimum(0.0, self._bank.distances(self.start, touching)) - _DEEPER
        if np.array_equal(near_margins, margins):
            return self._far
        self._bank.near.set(disabled, near_margins)
        if touching and self._kernel is not None:
            self._sunk = self._bank.sunk
            self._sunk.set(frozenset(range(self._bank.pair_count)).difference(touching), near_margins)
        return self._bank.near

    def _pairs_named(self, excused: Iterable[Pair]) -> frozenset[int]:
        """Indices of the pairs with these names, in either order; names that are not there excuse nothing."""
        indices: dict[str, list[int]] = {}
        for i, name in enumerate(self._names):
            indices.setdefault(name, []).append(i)
        first, second = self._bank.first, self._bank.second
        found: set[int] = set()
        for a, b in excused:
            one, other = indices.get(a, []), indices.get(b, [])
            either = (np.isin(first, one) & np.isin(second, other)) | (np.isin(first, other) & np.isin(second, one))
            found.update(np.flatnonzero(either).tolist())
        return frozenset(found)

    @property
    def kernel(self) -> KernelWorld | None:
        """The compiled kernel with this world's rules; None where it cannot be used."""
        return self._kernel

    @property
    def bank(self) -> ObstacleBank:
        """The geometry: the robot among the solids of the scene."""
        return self._bank

    def rules_at(self, q: Array) -> Rules:
        """Which pairs count when the robot is at q (dof,) [rad], and how far apart they must be."""
        return self._near if self._near is not self._far and self._travel(q) < self.contact_distance else self._far

    def pair(self, index: int) -> Pair:
        """Names of the link or attached object, and of what it is paired with."""
        return self._names[self._bank.first[index]], self._names[self._bank.second[index]]

    def _travel(self, q: Array) -> float:
        """Distance [m] of the TCP at q from where it was at the start."""
        frame = self.robot.model.frames[self.robot.tcp_frame]
        data = self._bank.data
        pin.forwardKinematics(self.robot.model, data, q)
        return math.dist(data.oMi[frame.parentJoint].act(frame.placement.translation), self._origin)

    def collides(self, q: Array) -> bool:
        """Whether the robot at q (dof,) [rad] touches itself or anything that it may not, or breaks a constraint."""
        if self.constraints is not None and not self.constraints.holds(q):
            return True
        if self._kernel is not None and self._kernel.colliding(q) >= 0:
            return True
        asked = self._asked_at(q)
        return asked is not None and asked.hit(q)

    def _asked_at(self, q: Array) -> Rules | None:
        """The rules that coal is asked about at q: all where there is no kernel, else those that it does not know."""
        if self._kernel is None:
            return self.rules_at(q)
        return self._sunk if self._sunk is not None and self._travel(q) < self.contact_distance else None

    def colliding_pair(self, q: Array) -> Pair | None:
        """Names of a link or attached object and of what it touches at q; None when nothing touches."""
        if self._kernel is not None:
            hit = self._kernel.colliding(q)
            if hit >= 0:
                close = self._kernel.distances(q)[0] <= _least(self.rules_at(q))
                return self.pair(int(close.argmax()) if close.any() else hit)
        rules = self._asked_at(q)
        if rules is None or not rules.hit(q):
            return None
        found = rules.pairs(q)
        return self.pair(found[0]) if found else None

    def _proved_free(self, q: Array, moves: float, tcp_moves: float) -> bool:
        """Whether all positions are free within which no point moves farther than `moves` [m] from where it is at q."""
        level = next((i for i, margin in enumerate(MARGINS) if margin >= moves), None)
        if level is None:
            return False
        near, far = (self._near, self._far) if self._kernel is None else (self._sunk, None)
        if near is far:
            return not self._far.hit(q, level)
        travel, rules = self._travel(q), []
        if travel + tcp_moves >= self.contact_distance:
            rules.append(far)
        if travel - tcp_moves < self.contact_distance:
            rules.append(near)
        return not any(rule.hit(q, level) for rule in rules if rule is not None)

    def edge_free(self, a: Array, b: Array) -> bool:
        """Whether the straight line in joint space from a to b (dof,) [rad] is free.

        Bisects: the middle being free with a margin of at least the way of any point to the ends proves the whole
        piece. Where nothing can be proved the pieces end at ways of 1 mm, and their middles decide.
        """
        if self.constraints is not None and not self.constraints.line_holds(a, b):
            return False
        if self._kernel is not None:
            proved = self._kernel.edge_free(a, b)
            if not proved or self._sunk is None:
                return proved
        span = b - a
        whole = float(np.abs(span) @ self._lever)
        tcp_whole = float(np.abs(span) @ self._tcp_lever)
        count = max(1, math.ceil(whole / (2 * MARGINS[-1])))
        half = 0.5 / count
        pieces = (np.arange(count) * 2 * half + half).tolist()
        while pieces:
            left = []
            for middle in pieces:
                q = a + middle * span
                if self._proved_free(q, whole * half, tcp_whole * half):
                    continue
                if self.collides(q):
                    return False
                left += [middle - half / 2, middle + half / 2]
            if whole * half <= MARGINS[1]:
                return True
            pieces, half = left, half / 2
        return True

    def first_collision(self, path: Array) -> Hit | None:
        """The first of the positions (N, dof) [rad] that collides; pieces between that are proved free are skipped."""
        found = None
        if self._kernel is not None:
            index, hit = self._kernel.first_collision(path)
            if index >= 0:
                q = path[index].copy()
                found = Hit(index, q, self.colliding_pair(q) or self.pair(hit))
                path = path[:index]
            if self._sunk is None or not len(path):
                return found
        stack = [(0, len(path) - 1)]
        while stack:
            i, j = stack.pop()
            m = (i + j) // 2
            q = path[m]
            if i < j:
                away = np.abs(path[i : j + 1] - q).max(axis=0)
                if self._proved_free(q, float(away @ self._lever), float(away @ self._tcp_lever)):
                    continue
                if m > i:
                    stack += [(m + 1, j), (i, m)]
                else:
                    stack += [(j, j), (i, i)]
                continue
            if self.collides(q):
                return Hit(m, q.copy(), self.colliding_pair(q) or ("unknown", "unknown"))
        return found

    def bends_free(self, path: SmoothPath, step: float) -> bool:
        """Whether the parabolas of a path are free whose straight lines are; looked for in steps [rad], or proved."""
        bent = (path.d0 != path.d1).any(axis=1)
        lengths = path.lengths[bent, None]
        d0, d1 = path.d0[bent] * lengths, path.d1[bent] * lengths
        cubics = np.stack([path.starts[bent], d0, 0.5 * (d1 - d0), np.zeros_like(d0)], axis=1)
        if self.constraints is not None and self.constraints.first_break(cubics) is not None:
            return False
        if self._kernel is None:
            return self.first_collision(path.positions(step)) is None
        if self._kernel.cubics_collision(cubics)[0] >= 0:
            return False
        return self._sunk is None or self.first_collision(path.positions(step)) is None

    def curves_judged(self, pieces: Array) -> tuple[bool, Hit | None]:
        """Whether cubics (N, 4, dof) in r from 0 to 1 are proved free; the collision that was found instead, if any."""
        if self._kernel is None:
            return False, None
        index, where = self._kernel.cubics_collision(pieces)
        if index < 0:
            return self._sunk is None, None
        piece = min(int(where), len(pieces) - 1)
        q = (where - piece) ** np.arange(4) @ pieces[piece]
        pair = self.colliding_pair(q)
        return False, None if pair is None else Hit(piece, q, pair)

    def edge_collision(self, a: Array, b: Array, step: float = 0.005) -> Hit | None:
        """The first collision on the straight line from a to b (dof,) [rad], looked for in steps [rad]."""
        return self.first_collision(interpolate([a, b], step))

    def obstruction(self, a: Array, b: Array, step: float) -> Obstruction:
        """Why the straight line from a to b (dof,) [rad] is not free; a collision is looked for in steps [rad]."""
        hit = self.edge_collision(a, b, step)
        if hit is None and self.constraints is not None:
            wrong = self.constraints.wrong_on_line(a, b)
            if wrong:
                return Obstruction("constraint", wrong, None)
        pair = hit.pair if hit else ("robot", "scene")
        return Obstruction("collision", f"{pair[0]} collides with {pair[1]}", pair)


def _least(rules: Rules) -> Array:
    """(pairs,) [m] how far apart pairs must be, EXCUSED for those that may touch or be in each other."""
    least = np.where(rules.margins < 0, EXCUSED, rules.margins)
    least[list(rules.disabled)] = EXCUSED
    return least


def interpolate(waypoints: Sequence[Array] | Array, step: float) -> Array:
    """Positions (N, dof) [rad] along straight lines between waypoints, no joint moving by more than `step` between."""
    pieces = [np.asarray(waypoints[0], dtype=float)[None, :]]
    for a, b in pairwise(waypoints):
        count = max(1, math.ceil(float(np.abs(b - a).max()) / step))
        pieces.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return np.concatenate(pieces)
