"""What has come in the way of the motion that runs: the rest of it, judged on each newer planning scene."""

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
from common.planning.obstacles import BadShape, ObstacleCache
from common.planning.retiming import cubics
from common.planning.robot_geometry import RobotGeometry
from common.planning.validation import timed_path
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix

Array = NDArray[np.float64]

MOVED = 0.005  # [m] what reaches no farther than so much beyond what was planned around is no news
FARTHER = 0.005  # [m] than it had to be kept, before what was in the way no longer is
_REMEMBERED = 32  # plans
_STEP = 0.02  # [rad] between states that are looked at where nothing can be proved
_MOST_STATES = 25_000  # that are looked at so: no motion of an arm is longer
_PERCEIVED = ("target", "contained", "attached")
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
_WAYS = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
_WAYS /= np.linalg.norm(_WAYS, axis=1, keepdims=True)


class NotWatched(ZencellError):
    """Why a motion cannot be judged."""


@dataclass(frozen=True)
class _Plan:
    request: PlanRequest
    scene: PlanningScene
    trajectory: JointTrajectory
    width: float | None  # between the fingers [m]
    known: Array  # (objects, ways) how far those of the scene reach [m]


class SceneMonitor:
    """Judges the motion that is followed. What it was planned around is no news, nor are the contacts that it may have.

    Of a motion that was planned elsewhere, or before a restart, it is not known what it was planned around: all of the
    scene counts then, but for contact of the gripper with perceived objects and for what a held object touches.
    """

    def __init__(self, config: RobotConfig, padding: float) -> None:
        """Load the robot, for this thread alone; perceived objects that are news are kept `padding` [m] away."""
        self.robot = RobotModel.load(config)
        self._cache = ObstacleCache(RobotGeometry(self.robot))
        self._gripper = config.gripper.links if config.gripper else []
        self._padding = padding
        self._plans: OrderedDict[str, _Plan] = OrderedDict()
        self.forget()

    def note(
        self, request: PlanRequest, scene: PlanningScene, trajectory: JointTrajectory, width: float | None = None
    ) -> None:
        """Remember what a plan was made on, with the fingers at a width [m]: it may be followed."""
        width = width if request.gripper_width is None else request.gripper_width
        self._plans[request.id] = _Plan(request, scene, trajectory, width, _reaches(scene.objects))
        while len(self._plans) > _REMEMBERED:
            self._plans.popitem(last=False)

    def knows(self, plan: str) -> bool:
        """Whether the answer to that plan request is remembered."""
        return plan in self._plans

    def forget(self, goal: str = "") -> None:
        """Nothing is followed, or nothing that can be judged."""
        self.goal = goal
        self._times, self._pieces = np.zeros(1), np.zeros((0, 4, self.robot.dof))
        self._plan: _Plan | None = None
        self._judged: PlanningScene | None = None
        self._found = self._problem = ""  # what is in the way, and of what

    def follow(self, goal: str, plan: str, trajectory: JointTrajectory | None = None) -> None:
        """Judge this goal from now on: the answer to a plan request, or any trajectory.

        Raises:
            NotWatched: it is not of this robot.
        """
        self.forget(goal)
        self._plan = self._plans.get(plan)
        if self._plan is not None:
            trajectory = self._plan.trajectory
        if trajectory is None or sorted(trajectory.joint_names) != sorted(self.robot.joint_names):
            raise NotWatched(f"goal {goal!r} has other joints than those that are planned for")
        if not trajectory.points:
            raise NotWatched(f"the trajectory of goal {goal!r} has no points")
        columns = [trajectory.joint_names.index(name) for name in self.robot.joint_names]
        timed = timed_path(trajectory)
        self._times, self._pieces = timed.times, cubics(timed)[:, :, columns]

    def in_the_way(self, scene: PlanningScene, progress: float) -> str:
        """What the rest of the motion would touch, in words; empty when it is free.

        Args:
            scene: the newest; one with the same in it as before is not looked at again.
            progress: the share of the trajectory that is behind the robot.
        """
        before = self._judged
        if before is not None and before.objects == scene.objects and before.attached == scene.attached:
            return self._problem
        rest, news, hit = self._rest(progress), self._news(scene), None
        self._judged = scene
        if news and len(rest):
            try:
                hit = self._hit(rest, scene, news, 0.0)
                if hit is None and (still := [thing for thing in news if thing.id == self._found]):
                    hit = self._hit(rest, scene, still, FARTHER)
            except BadShape as error:
                raise NotWatched(str(error)) from None
        names = {thing.id for thing in news}
        found = [name for name in hit.pair if name in names] if hit is not None else []
        other = [name for name in hit.pair if name not in names] if hit is not None else []
        self._found = found[0] if found else ""
        self._problem = f"{found[0]} is in the way of {other[0] if other else 'the robot'}" if found else ""
        return self._problem

    def _rest(self, progress: float) -> Array:
        """(N, 4, dof) the cubics that are still ahead, the first of them cut where the robot is."""
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

    def _news(self, scene: PlanningScene) -> list[CollisionObject]:
        """What reaches to where nothing was when the motion was planned, and does not move with the hand in it."""
        if self._plan is None:
            return scene.objects
        attach = self._plan.request.attach
        objects = [thing for thing in scene.objects if thing.id != attach]
        if not objects:
            return []
        if not len(self._plan.known):
            return objects
        beyond = (_reaches(objects)[:, None] - self._plan.known[None]).max(axis=2).min(axis=1)
        return [thing for thing, by in zip(objects, beyond.tolist(), strict=True) if by > MOVED]

    def _hit(self, rest: Array, scene: PlanningScene, news: list[CollisionObject], more: float) -> Hit | None:
        plan = self._plan
        if plan is None:
            touched = [thing.id for thing in news if thing.role in _PERCEIVED]
            world = CollisionWorld(
                self.robot, scene, start=rest[0, 0], padding=more,
                allowed=[(link, name) for link in self._gripper for name in touched], cache=self._cache)
        else:
            request, attached = plan.request, [thing.object.id for thing in scene.attached]
            around = PlanningScene(
                header=scene.header, objects=news, attached=scene.attached,
                allowed_collisions=[*scene.allowed_collisions, *plan.scene.allowed_collisions])
            if request.attach and request.attach not in attached:  # the scene does not know yet that it is held
                around.objects = [*news, *(thing for thing in plan.scene.objects if thing.id == request.attach)]
                around.attached = [*plan.scene.attached]
            world = CollisionWorld(
                self.robot, around, start=self._pieces[0, 0], padding=self._padding + more,
                allowed=request.allowed_collisions, attach=request.attach, attach_pose=request.attach_pose,
                release=request.release, contact_distance=request.contact_distance, cache=self._cache,
                width=plan.width)
        proved, hit = world.curves_judged(rest)
        return hit if proved or hit is not None else world.first_collision(_states(rest))


def _states(pieces: Array) -> Array:
    """(N, dof) [rad] along cubics, no joint moving much farther than the step between.

    Raises:
        NotWatched: they would be too many.
    """
    counts = np.maximum(1, np.ceil(np.abs(pieces[:, 1:]).sum(axis=1).max(axis=1) / _STEP))
    if not counts.sum() <= _MOST_STATES:  # nor where they are no numbers
        raise NotWatched(f"to look at it takes more than {_MOST_STATES} states")
    found = []
    for piece, count in zip(pieces, counts.astype(int), strict=True):
        r = np.arange(count)[:, None] / count
        found.append(piece[0] + r * (piece[1] + r * (piece[2] + r * piece[3])))
    return np.concatenate([*found, pieces[-1].sum(axis=0)[None]])


def _reaches(objects: Sequence[CollisionObject]) -> Array:
    """(objects, ways) how far each reaches from the origin in so many directions [m]: its support function."""
    return np.array([_reach(thing) for thing in objects]).reshape(len(objects), len(_WAYS))


def _reach(thing: CollisionObject) -> Array:
    T, size = pose_to_matrix(thing.pose), thing.dimensions
    middle, along = _WAYS @ T[:3, 3], _WAYS @ T[:3, :3]
    if thing.shape == "sphere":
        return np.asarray(middle + size[0])
    if thing.shape == "cylinder":
        flat = np.abs(along[:, 2])
        return np.asarray(middle + size[0] * np.sqrt(np.maximum(0.0, 1 - flat**2)) + 0.5 * size[1] * flat)
    points = 0.5 * _CORNERS * size if thing.shape == "box" else np.array(
        [(x, y, z) for x, y in thing.outline for z in (-0.5 * size[0], 0.5 * size[0])])
    return np.asarray(middle + (along @ points.T).max(axis=1))
