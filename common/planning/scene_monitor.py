"""Monitor the running motion: check the rest of it against each newer planning scene."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from common.config import RobotConfig
from common.errors import ZencellError
from common.messages import CollisionObject, JointTrajectory, PlanningScene, PlanRequest
from common.planning.collision import CollisionWorld, Hit
from common.planning.contact_rules import PERCEIVED
from common.planning.moving_objects import scene_for
from common.planning.obstacles import InvalidShape, ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import cubics, timed_path
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix

Array = NDArray[np.float64]

MOVED = 0.005  # [m] an object that reaches no farther beyond the planned scene is not new
FARTHER = 0.005  # [m] additional clearance before an obstruction counts as gone
_MAX_PLANS = 32
_STEP = 0.02  # [rad] between states that are checked where nothing can be proved
_MAX_STATES = 25_000  # that are checked so: no motion of an arm is longer
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
_DIRECTIONS = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


class NotMonitored(ZencellError):
    """Why a motion cannot be checked."""


@dataclass(frozen=True)
class _Plan:
    request: PlanRequest
    scene: PlanningScene
    trajectory: JointTrajectory
    width: float | None  # of the gripper [m]
    reaches: Array  # (objects, directions) of the scene's objects [m]


class SceneMonitor:
    """Checks the running motion. Objects it was planned around are not new, and contacts it may have are allowed.

    For a motion that was planned elsewhere, or before a restart, the planned scene is unknown: then all objects count,
    except for contact of the gripper with perceived objects and for what an attached object touches.
    """

    def __init__(self, config: RobotConfig, padding: float) -> None:
        """Load the robot, for this thread alone; new perceived objects get `padding` [m] more distance."""
        self.robot = RobotModel.load(config)
        self._cache = ObstacleCache(RobotGeometry(self.robot))
        self._gripper = config.gripper.links if config.gripper else []
        self._padding = padding
        self._plans: OrderedDict[str, _Plan] = OrderedDict()
        self.unfollow()

    def add_plan(
        self, request: PlanRequest, scene: PlanningScene, trajectory: JointTrajectory, width: float | None = None
    ) -> None:
        """Store a plan that may be executed, with its scene and the gripper's width [m]."""
        width = width if request.gripper_width is None else request.gripper_width
        self._plans[request.id] = _Plan(request, scene, trajectory, width, _reaches(scene.objects))
        while len(self._plans) > _MAX_PLANS:
            self._plans.popitem(last=False)

    def has_plan(self, plan: str) -> bool:
        """Return whether the answer to a plan request is stored."""
        return plan in self._plans

    def unfollow(self, goal: str = "") -> None:
        """Check no motion; `goal` is running but cannot be checked."""
        self.goal = goal
        self._times, self._pieces = np.zeros(1), np.zeros((0, 4, self.robot.dof))
        self._plan: _Plan | None = None
        self._checked: PlanningScene | None = None
        self._obstructing = self._problem = ""  # id of the obstructing object, and the message

    def follow(self, goal: str, plan: str, trajectory: JointTrajectory | None = None) -> None:
        """Check this goal from now on: a stored plan, or any trajectory.

        Raises:
            NotMonitored: the trajectory is not of this robot, or empty.
        """
        self.unfollow(goal)
        self._plan = self._plans.get(plan)
        if self._plan is not None:
            trajectory = self._plan.trajectory
        if trajectory is None or sorted(trajectory.joint_names) != sorted(self.robot.joint_names):
            raise NotMonitored(f"goal {goal!r} moves other joints than this planner's robot has")
        if not trajectory.points:
            raise NotMonitored(f"the trajectory of goal {goal!r} has no points")
        columns = [trajectory.joint_names.index(name) for name in self.robot.joint_names]
        timed = timed_path(trajectory)
        self._times, self._pieces = timed.times, cubics(timed)[:, :, columns]

    def find_obstruction(self, scene: PlanningScene, progress: float) -> str:
        """Return a message about what the rest of the motion would touch; empty if it is free.

        Args:
            scene: the newest; one with the same content as the last is not checked again.
            progress: the executed share of the trajectory.

        Raises:
            NotMonitored: the scene or the motion cannot be checked.
        """
        last = self._checked
        if last is not None and last.objects == scene.objects and last.attached == scene.attached:
            return self._problem
        rest, new, hit = self._rest(progress), self._new_objects(scene), None
        self._checked = scene
        if new and len(rest):
            try:
                hit = self._hit(rest, scene, new, 0.0)
                if hit is None and (still := [item for item in new if item.id == self._obstructing]):
                    hit = self._hit(rest, scene, still, FARTHER)
            except InvalidShape as error:
                raise NotMonitored(str(error)) from None
        names = {item.id for item in new}
        found = [name for name in hit.pair if name in names] if hit is not None else []
        other = [name for name in hit.pair if name not in names] if hit is not None else []
        self._obstructing = found[0] if found else ""
        self._problem = f"{found[0]} obstructs {other[0] if other else 'the robot'}" if found else ""
        return self._problem

    def _rest(self, progress: float) -> Array:
        """Return (N, 4, dof) the cubics that are still ahead, the first of them cut where the robot is."""
        time = progress * self._times[-1]
        first = int(np.clip(np.searchsorted(self._times, time, side="right") - 1, 0, len(self._pieces)))
        rest = self._pieces[first:].copy()
        if len(rest):
            a = (time - self._times[first]) / (self._times[first + 1] - self._times[first])
            b = 1 - a
            c0, c1, c2, c3 = rest[0]
            rest[0] = [c0 + a * (c1 + a * (c2 + a * c3)), b * (c1 + a * (2 * c2 + 3 * a * c3)),
                       b**2 * (c2 + 3 * a * c3), b**3 * c3]
        return rest

    def _new_objects(self, scene: PlanningScene) -> list[CollisionObject]:
        """Return objects that reach where nothing was when the motion was planned, without the attached one."""
        if self._plan is None:
            return scene.objects
        attach = self._plan.request.attach
        objects = [item for item in scene_for(self._plan.request, scene).objects if item.id != attach]
        if not objects:
            return []
        if not len(self._plan.reaches):
            return objects
        beyond = (_reaches(objects)[:, None] - self._plan.reaches[None]).max(axis=2).min(axis=1)
        return [item for item, by in zip(objects, beyond.tolist(), strict=True) if by > MOVED]

    def _hit(self, rest: Array, scene: PlanningScene, new: list[CollisionObject], clearance: float) -> Hit | None:
        """Return the first collision of the rest with new objects; `clearance` [m] is added to their distance."""
        plan = self._plan
        if plan is None:
            touchable = [item.id for item in new if item.role in PERCEIVED]
            world = CollisionWorld(
                self.robot, scene, start=rest[0, 0], padding=clearance,
                allowed=[(link, name) for link in self._gripper for name in touchable], cache=self._cache)
        else:
            request, attached = plan.request, [item.object.id for item in scene.attached]
            around = PlanningScene(
                header=scene.header, objects=new, attached=scene.attached,
                allowed_collisions=[*scene.allowed_collisions, *plan.scene.allowed_collisions])
            if request.attach and request.attach not in attached:  # the scene does not show yet that it is attached
                around.objects = [*new, *(item for item in plan.scene.objects if item.id == request.attach)]
                around.attached = [*plan.scene.attached]
            world = CollisionWorld(
                self.robot, around, start=self._pieces[0, 0], padding=self._padding + clearance,
                allowed=request.allowed_collisions, attach=request.attach, attach_pose=request.attach_pose,
                release=request.release, contact_distance=request.contact_distance, cache=self._cache,
                width=plan.width)
        proved, hit = world.check_cubics(rest)
        return hit if proved or hit is not None else world.first_collision(_states(rest))


def _states(pieces: Array) -> Array:
    """Return (N, dof) [rad] along cubics, about one step apart.

    Raises:
        NotMonitored: there would be too many.
    """
    counts = np.maximum(1, np.ceil(np.abs(pieces[:, 1:]).sum(axis=1).max(axis=1) / _STEP))
    if not counts.sum() <= _MAX_STATES:  # false also for NaN
        raise NotMonitored(f"the check takes more than {_MAX_STATES} states")
    found = []
    for piece, count in zip(pieces, counts.astype(int), strict=True):
        r = np.arange(count)[:, None] / count
        found.append(piece[0] + r * (piece[1] + r * (piece[2] + r * piece[3])))
    return np.concatenate([*found, pieces[-1].sum(axis=0)[None]])


def _reaches(objects: Sequence[CollisionObject]) -> Array:
    """Return (objects, directions) how far each object reaches from the origin [m]: its support function."""
    return np.array([_reach(item) for item in objects]).reshape(len(objects), len(_DIRECTIONS))


def _reach(item: CollisionObject) -> Array:
    T, size = pose_to_matrix(item.pose), item.dimensions
    middle, along = _DIRECTIONS @ T[:3, 3], _DIRECTIONS @ T[:3, :3]
    if item.shape == "sphere":
        return np.asarray(middle + size[0])
    if item.shape == "cylinder":
        flat = np.abs(along[:, 2])
        return np.asarray(middle + size[0] * np.sqrt(np.maximum(0.0, 1 - flat**2)) + 0.5 * size[1] * flat)
    points = 0.5 * _CORNERS * size if item.shape == "box" else np.array(
        [(x, y, z) for x, y in item.outline for z in (-0.5 * size[0], 0.5 * size[0])])
    return np.asarray(middle + (along @ points.T).max(axis=1))
