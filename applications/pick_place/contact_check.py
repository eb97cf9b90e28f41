"""Check a recorded motion for contacts of the arm with the balls where they really were."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.config import Cell, Surroundings
from common.messages import CollisionObject, GripperState, JointState, PlanningScene, Pose, PoseArray
from common.planning.collision import CollisionWorld, interpolate
from common.planning.contact_rules import Pair
from common.planning.obstacles import ObstacleCache
from common.planning.robot_geometry import RobotGeometry
from common.robot.finger_joints import measured_width
from common.robot.model import RobotModel
from common.robot.transforms import invert, matrix_to_pose
from common.scene.fixtures import fixed_objects
from common.topics import Topic

Array = NDArray[np.float64]
S = TypeVar("S", JointState, GripperState, PoseArray)

STEP = 0.01  # [rad] between the joint positions that are checked
AT_HAND = 0.04  # [m] a ball closer to the tool center point than this is the one that the fingers grasp or release
ABOUT = 0.16  # [m] distance from the gripper command within which the fingers may touch that ball


@dataclass
class RecordedMotion:
    """Recorded joint states, gripper states and ground truth, in order of arrival; repeated states count once."""

    joints: list[JointState] = field(default_factory=list)
    grips: list[GripperState] = field(default_factory=list)
    balls: list[PoseArray] = field(default_factory=list)

    def listeners(self) -> dict[Topic[Any], Callable[[float, Any], None]]:
        """Return the listeners for the run aggregator."""
        return {
            topics.JOINT_STATES: lambda _, state: _append_new(self.joints, state),
            topics.GRIPPER_STATE: lambda _, state: _append_new(self.grips, state),
            SCENE_BALLS: lambda _, balls: _append_new(self.balls, balls),
        }


def _append_new(messages: list[S], message: S) -> None:
    if not messages or message.header.stamp > messages[-1].header.stamp:  # a state is published again each second
        messages.append(message)


@dataclass(frozen=True)
class Contact:
    """A pair in contact and its time: cell time [s] since the first joint state."""

    time: float
    pair: Pair

    def __str__(self) -> str:
        return f"{self.pair[0]} - {self.pair[1]} at {self.time:.2f} s"


@dataclass(frozen=True)
class _Window:
    """Samples `first` to `last` in which the gripper's links may touch a ball, because they grasp or release it."""

    ball: str
    first: int
    last: int


class ContactCheck:
    """Checks recordings of one cell."""

    def __init__(self, cell: Cell, step: float = STEP) -> None:
        """Load the robot's hulls; joint positions are checked every `step` [rad]."""
        self._step = step
        self.robot = RobotModel.load(cell.robot)
        self.cache = ObstacleCache(RobotGeometry(self.robot))
        self.around = Surroundings.model_validate(cell.section(Surroundings).model_dump())
        assert cell.robot.gripper is not None
        self.gripper, self.gripper_links = cell.robot.gripper, cell.robot.gripper.links
        self.checked = 0  # joint positions checked so far

    def contacts(self, recording: RecordedMotion) -> list[Contact]:
        """Return every pair in contact, once for each time.

        A held ball counts as part of the arm; until it is lifted by 2 cm it may touch what it touched at the grasp. A
        falling ball is ignored.
        """
        stamps = np.array([state.header.stamp for state in recording.joints])
        path = np.array([self.robot.order(s.name, s.position) for s in recording.joints])
        places = np.array([self.robot.fk(q)[:3, 3] for q in path])
        windows = list(self._windows(recording, stamps, places))
        found: list[Contact] = []
        for truth, first, last in self._spans(recording, stamps):
            cuts = {first, last}
            for window in windows:
                cuts |= {cut for cut in (window.first, window.last) if first < cut < last}
            for begin, end in pairwise(sorted(cuts)):
                allowed = [
                    (link, w.ball) for w in windows if w.first <= begin and end <= w.last for link in self.gripper_links
                ]
                widths = [measured_width(self.gripper, state.name, state.position)
                          for state in recording.joints[begin : end + 1]]
                world = self._world(truth, path, stamps, first, allowed, _widest(widths))
                for index, pair in self._touching(world, path[begin : end + 1]):
                    found.append(Contact((stamps[begin + index] - stamps[0]) * 1e-9, pair))
        return found

    def _touching(self, world: CollisionWorld, states: Array) -> Iterator[tuple[int, Pair]]:
        """Yield the index of the state before a contact and the pair, once for each contact."""
        pieces = [interpolate([a, b], self._step)[1:] for a, b in pairwise(states)]
        fine = np.concatenate([states[:1], *pieces])
        owners = np.concatenate([[0], *(np.full(len(piece), i) for i, piece in enumerate(pieces))]).astype(int)
        self.checked += len(fine)
        at = 0
        while at < len(fine) and (hit := world.first_collision(fine[at:])) is not None:
            at += hit.index
            yield int(owners[at]), hit.pair
            while at < len(fine) and world.collides(fine[at]):
                at += 1

    def _spans(self, recording: RecordedMotion, stamps: NDArray[np.int64]) -> Iterator[tuple[PoseArray, int, int]]:
        """Yield ground truths between which only held and falling balls move, with their first and last sample."""
        changes: list[PoseArray] = []
        for balls in recording.balls:
            if not changes or _resting(balls) != _resting(changes[-1]):
                changes.append(balls)
        starts = [max(0, int(np.searchsorted(stamps, b.header.stamp, side="right")) - 1) for b in changes]
        starts[0] = 0
        for balls, first, last in zip(changes, starts, [*starts[1:], len(stamps) - 1], strict=True):
            if last > first:
                yield balls, first, last

    def _windows(
        self, recording: RecordedMotion, stamps: NDArray[np.int64], places: Array
    ) -> Iterator[_Window]:
        """Yield the balls that the fingers grasp or release, and the samples around it."""
        truth = iter(recording.balls)
        balls = next(truth)
        following = next(truth, None)
        before = ""
        for state in recording.grips:
            if not state.id or state.id == before:
                continue
            before = state.id
            while following is not None and following.header.stamp <= state.header.stamp:
                balls, following = following, next(truth, None)
            at = min(len(stamps) - 1, int(np.searchsorted(stamps, state.header.stamp)))
            about = np.linalg.norm(places - places[at], axis=1) < ABOUT
            first = at - int(np.argmin(about[at::-1])) + 1 if not about[: at + 1].all() else 0
            last = at + int(np.argmin(about[at:])) - 1 if not about[at:].all() else len(stamps) - 1
            for name, pose in zip(balls.ids, balls.poses, strict=True):
                if np.linalg.norm(places[at] - [pose.position.x, pose.position.y, pose.position.z]) < AT_HAND:
                    yield _Window(name, first, last)

    def _world(
        self, truth: PoseArray, path: Array, stamps: NDArray[np.int64], first: int, allowed: list[Pair],
        width: float | None,
    ) -> CollisionWorld:
        held = next((i for i, label in enumerate(truth.labels) if label == "held"), None)
        objects = fixed_objects(self.around)
        for i, name in enumerate(truth.ids):
            if truth.labels[i] in ("table", "box", "held"):
                objects.append(CollisionObject(
                    id=name, role="target", shape="sphere", dimensions=[self.around.ball_radius], pose=truth.poses[i]))
        grip: Pose | None = None
        if held is not None:
            p = truth.poses[held].position
            T_world_ball = np.eye(4)
            T_world_ball[:3, 3] = p.x, p.y, p.z
            at = min(len(stamps) - 1, int(np.searchsorted(stamps, truth.header.stamp)))
            T_tcp_ball = invert(self.robot.fk(path[at])) @ T_world_ball
            T_tcp_ball[:3, :3] = np.eye(3)  # a ball has no orientation
            grip = matrix_to_pose(T_tcp_ball)
        return CollisionWorld(
            self.robot, PlanningScene(header=truth.header, objects=objects), start=path[first], padding=0.0,
            allowed=allowed, attach=truth.ids[held] if held is not None else "", attach_pose=grip, cache=self.cache,
            width=width,
        )


def _widest(widths: Sequence[float | None]) -> float | None:
    """Return the largest measured width [m]; None if one is unknown."""
    known = [width for width in widths if width is not None]
    return max(known) if known and len(known) == len(widths) else None


def _resting(balls: PoseArray) -> tuple[object, ...]:
    """Return which ball is held, and the positions of the others."""
    return tuple(
        (name, label, None if label == "held" else (p.position.x, p.position.y, p.position.z))
        for name, label, p in zip(balls.ids, balls.labels, balls.poses, strict=True)
        if label in ("table", "box", "held")
    )
