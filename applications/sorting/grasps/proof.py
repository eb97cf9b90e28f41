"""The proof of grasps: joint positions for approach and grasp, and a line between them that is free of collisions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from applications.sorting.grasps.candidates import Candidates
from applications.sorting.grasps.height_map import HeightMap
from applications.sorting.topics import MAX_GRASPS, GraspCandidate
from common.config import RobotConfig, Surroundings
from common.config.basics import Section
from common.errors import UnknownName
from common.messages import Header, PlanningScene
from common.planning.collision import CollisionWorld
from common.planning.ik import solve_ik
from common.planning.obstacles import ObstacleCache
from common.planning.point_obstacles import PointObstacle, downsampled
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.scene.fixtures import fixed_objects
from common.time_source import monotonic

Array = NDArray[np.float64]

POINTS = "points"  # name of what the camera saw, in reasons
_HALF_TURN = transform(rpy_to_matrix(0.0, 0.0, math.pi), (0.0, 0.0, 0.0))  # fingers close along the same line
_LOW = 0.006  # [m] above the floor: lower points are the floor itself, which is a solid
_LIKE, _LIKE_TURN = 0.02, math.radians(30.0)  # [m], [rad] within which a grasp is like another one
_SHORT = 1e-9  # [m]
_PATIENCE = 3  # times the time limit while nothing is proved
_SAME = 0.01  # [rad] between joint positions that are one solution
_SAME_BRANCH = 1.5  # [rad] between approach and grasp in any joint


class ProofOptions(Section):
    """How many grasps are proved, how long that may take, and how measured points count."""

    wanted: int = Field(20, ge=1, le=MAX_GRASPS, description="proved grasps")
    for_each: int = Field(3, ge=1, le=MAX_GRASPS, description="of these, of one object")
    seconds: float = Field(0.1, gt=0, le=10, description="time limit [s]")
    approach: tuple[float, ...] = Field((0.10, 0.07), min_length=1, description="way back from the grasp along the "
                                                                                "tool, the first that is free [m]")
    side: float = Field(0.004, gt=0, le=0.05, description="of cubes that measured points are merged in [m]")
    radius: float = Field(0.002, gt=0, le=0.02, description="of the spheres about them [m]")
    restarts: int = Field(4, ge=0, le=100, description="random starts of the inverse kinematics, if home fails")


@dataclass(frozen=True)
class Proof:
    """Result for one image.

    Attributes:
        grasps: proved ones first, then others; each the best first.
        reasons: why an object (index) has no proved grasp.
        tried: number of candidates that were examined; seconds: that it took.
    """

    grasps: list[GraspCandidate]
    reasons: dict[int, str]
    tried: int
    seconds: float


@dataclass(frozen=True, eq=False)
class _Found:
    """Joint positions (dof,) [rad] and the pose (4, 4) of the TCP at the grasp; or why there are none."""

    q_approach: Array | None = None
    q: Array | None = None
    T: Array | None = None
    back: float = 0.0
    why: str = ""


class Prover:
    """Proves grasps with the planning kernel against fixtures, containers and measured points. Not thread-safe."""

    def __init__(self, config: RobotConfig, around: Surroundings, options: ProofOptions | None = None) -> None:
        """Load the robot, for this thread alone.

        Raises:
            ConfigError: a description or a mesh that cannot be used.
        """
        self.options = options or ProofOptions()
        self.robot = RobotModel.load(config)
        self.geometry = RobotGeometry(self.robot)
        self._cache = ObstacleCache(self.geometry)
        self._scene = PlanningScene(header=Header(frame_id="world"), objects=fixed_objects(around))
        self._home = _home(self.robot)
        self._rng = np.random.default_rng(0)
        self._last: Array | None = None  # positions at the newest proved grasp: the next may be near
        self._world(self._home, PointObstacle(POINTS, np.array([[0.0, 0.0, -1.0, 0.001]])))  # builds shapes once

    def prove(self, found: Candidates, objects: Sequence[str], home: ArrayLike | None = None) -> Proof:
        """Return grasps as messages, until enough are proved or the time is over.

        Args:
            found: candidates, the best first.
            objects: id of each object index.
            home: (dof,) [rad] where the arm starts; default: its named pose.
        """
        began = monotonic()
        start = self._home if home is None else np.asarray(home, dtype=float)
        points = PointObstacle(POINTS, measured_spheres(found.heights, self.options.side, self.options.radius))
        world = self._world(start, points)
        grasps: list[GraspCandidate] = []
        proved: dict[int, list[int]] = {}
        reasons = dict(found.reasons)
        failed: list[GraspCandidate] = []
        tried = 0
        for i in self._order(found, proved):
            limit = self.options.seconds * (1 if grasps else _PATIENCE)
            if monotonic() - began > limit or len(grasps) >= self.options.wanted:
                break
            tried += 1
            result = self._prove(found.T[i], float(found.opening[i]), start, world)
            index = int(found.object[i])
            message = self._message(found, i, objects[index], result)
            if result.q is None:
                failed.append(message)
                reasons.setdefault(index, result.why)
                continue
            self._last = result.q
            grasps.append(message)
            proved.setdefault(index, []).append(i)
        for index in proved:
            reasons.pop(index, None)
        for index in set(found.object.tolist()) - set(proved):
            reasons.setdefault(index, "not examined: better grasps of other objects came first")
        return Proof((grasps + failed)[:MAX_GRASPS], reasons, tried, monotonic() - began)

    def _order(self, found: Candidates, proved: dict[int, list[int]]) -> Iterator[int]:
        """Yield candidates, the best first, but those like a proved one of the same object after all others.

        An object whose grasp fails then has others that differ from it.
        """
        position, axis = found.T[:, :3, 3], found.contacts[:, 1] - found.contacts[:, 0]
        axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), _SHORT)
        later = []
        for i in range(len(found)):
            others = proved.get(int(found.object[i]), [])
            if len(others) >= self.options.for_each:
                continue
            near = np.linalg.norm(position[others] - position[i], axis=1) < _LIKE
            if (near & (np.abs(axis[others] @ axis[i]) > math.cos(_LIKE_TURN))).any():
                later.append(i)
            else:
                yield i
        yield from (i for i in later if len(proved.get(int(found.object[i]), [])) < self.options.for_each)

    def _prove(self, T: Array, opening: float, start: Array, world: CollisionWorld) -> _Found:
        """Return joint positions for a grasp (4, 4), in either direction of the gripper, or why there are none."""
        why = ""
        for restarts in dict.fromkeys((0, self.options.restarts)):
            ways = self._ways(T, start, restarts)
            for pose, q in ways:
                world.bank.open_fingers(opening)
                world.bank.kernel()  # takes the fingers' poses
                found = self._free(world, pose, q)
                if found.q is not None:
                    return found
                why = why or found.why
        return _Found(why=why or self._unreachable(T))

    def _world(self, start: Array, points: PointObstacle) -> CollisionWorld:
        """Return the arm among fixtures, containers and points, with fingers that are moved later."""
        return CollisionWorld(self.robot, self._scene, start=start, cache=self._cache, points=[points])

    def _ways(self, T: Array, start: Array, restarts: int) -> list[tuple[Array, Array]]:
        """Return poses of the TCP for a grasp, with joint positions (dof,) [rad], the nearest to the start first.

        Args:
            T: (4, 4) of the TCP.
            start: (dof,) [rad].
            restarts: random starts instead of the start and the newest solution, if not 0.
        """
        seeds = [start] if self._last is None else [start, self._last]
        if restarts:
            seeds = list(self._rng.uniform(self.robot.lower, self.robot.upper, (restarts, self.robot.dof)))
        ways: list[tuple[Array, Array]] = []
        for pose in (T, T @ _HALF_TURN):
            for seed in seeds:
                q = solve_ik(self.robot, pose, seed, restarts=0)
                if q is not None and all(np.abs(q - other).max() > _SAME for _, other in ways):
                    ways.append((pose, q))
        return sorted(ways, key=lambda way: float(np.abs(way[1] - start).max()))

    def _free(self, world: CollisionWorld, pose: Array, q: Array) -> _Found:
        """Return joint positions for a grasp and its approach if both and the line between them are free."""
        if world.collides(q):
            return _Found(why=f"at the grasp {_colliding(world, q)}")
        why = ""
        for back in self.options.approach:
            before = pose.copy()
            before[:3, 3] -= back * pose[:3, 2]
            q_approach = solve_ik(self.robot, before, q, restarts=0)
            if q_approach is None or np.abs(q_approach - q).max() > _SAME_BRANCH:
                why = why or f"no joint positions {1e3 * back:.0f} mm above it"
            elif not world.edge_free(q_approach, q):
                why = why or f"on the way down {world.obstruction(q_approach, q, 0.02).message}"
            else:
                return _Found(q_approach, q, pose, back)
        return _Found(why=why)

    def _unreachable(self, T: Array) -> str:
        away = float(np.linalg.norm(T[:3, 3] - self.robot.foot))
        if away > self.robot.reach:
            return f"it is {away:.2f} m from the first joint; the arm reaches {self.robot.reach:.2f} m"
        return "no joint positions within the limits put the gripper there"

    def _message(self, found: Candidates, i: int, name: str, result: _Found) -> GraspCandidate:
        T = found.T[i] if result.T is None else result.T
        approach = T.copy()
        approach[:3, 3] -= (result.back or self.options.approach[0]) * T[:3, 2]
        return GraspCandidate(
            id=f"{name}/{i}", object=name, pose=matrix_to_pose(T), approach=matrix_to_pose(approach),
            width=float(found.width[i]), opening=float(found.opening[i]), score=float(found.score[i]),
            parts={label: float(values[i]) for label, values in found.parts.items()}, proved=result.q is not None,
            q_approach=[] if result.q_approach is None else result.q_approach.tolist(),
            q=[] if result.q is None else result.q.tolist(), why=result.why,
        )


def measured_spheres(heights: HeightMap, side: float, radius: float) -> Array:
    """Return spheres (N, 4), centre and radius [m], about the surface that was measured, its steps as vertical faces.

    Args:
        heights: the map. The floor and what is outside its labels and as low is left out.
        side: of cubes in each of which one sphere is left [m].
        radius: of the spheres [m]: larger ones would reach out of the surface and into the fingers next to it.
    """
    top, step = heights.height, heights.step
    lowest = np.float32(heights.floor + _LOW)
    rows, columns = np.nonzero(heights.measured & (top > lowest))
    z = top[rows, columns]
    below = np.maximum(heights.lowest[rows, columns], lowest)  # of the cells around
    count = np.maximum(np.floor((z - below) / side), 0).astype(int)
    owner = np.repeat(np.arange(len(z)), count + 1)
    level = np.arange(len(owner)) - np.repeat(np.cumsum(count + 1) - count - 1, count + 1)
    xy = heights.origin + step * (np.stack([columns, rows], axis=1) + 0.5)
    points = np.column_stack([xy[owner], z[owner] - side * level])
    spheres = downsampled(points, side)
    spheres[:, 3] = radius
    return spheres


def _colliding(world: CollisionWorld, q: Array) -> str:
    pair = world.colliding_pair(q)
    return "the robot collides" if pair is None else f"{pair[0]} collides with {pair[1]}"


def _home(robot: RobotModel) -> Array:
    """Return the arm's home (dof,) [rad], the middle of its limits without one."""
    try:
        return robot.named("home")
    except UnknownName:
        return np.asarray((robot.lower + robot.upper) / 2)
