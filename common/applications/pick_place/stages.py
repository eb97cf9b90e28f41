"""What a task asks for: moves and gripper commands in a row, and what it knows when it decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from common import messages as m
from common.applications.pick_place.messages import TaskState

Place = tuple[float, float, float]
Spots = list[tuple[float, float]]


@dataclass
class Target:
    """An object that was seen: its place [m] in world, and its track id in the planning scene."""

    id: str
    position: Place


@dataclass(eq=False)
class Cycle:
    """Taking one object to the container, and the yaws that are still to be tried for it."""

    target: Target
    yaws: list[float] = field(default_factory=list)
    begun: bool = False
    first_error: str = ""


@dataclass(eq=False)
class Move:
    """A motion of the arm; `trajectory` is there once it was planned, around what stood at `planned_around`."""

    name: str
    state: TaskState
    goal: m.PoseGoal | m.JointGoal
    cycle: Cycle | None = None
    straight: bool = False
    touches_target: bool = False
    carries: bool = False
    allowed: list[tuple[str, str]] = field(default_factory=list)
    trajectory: m.JointTrajectory | None = None
    planned_around: Spots = field(default_factory=list)

    def end(self) -> list[float]:
        """Joint positions [rad] at its end; empty when it is not planned."""
        return self.trajectory.points[-1].positions if self.trajectory else []


@dataclass(eq=False)
class Grip:
    """A motion of the fingers to a width [m]."""

    name: str
    state: TaskState
    width: float
    cycle: Cycle | None = None


Stage = Move | Grip
Command = m.PlanRequest | m.ExecuteRequest | m.GripperCommand | m.StopRequest | m.HoldRequest


@dataclass
class View:
    """What the task knows at an instant: only what was perceived or reported.

    Times are cell time [s]. `targets` were validated in the frame of `targets_stamp`. `tcp` is (x, y, z) of the tool
    centre point in world [m].
    """

    now: float
    targets: list[Place] = field(default_factory=list)
    targets_stamp: float = 0.0
    scene: m.PlanningScene | None = None
    gripper: m.GripperState | None = None
    motion: m.MotionStatus | None = None
    tcp: Place | None = None
    trouble: str = ""  # why no motion may begin

    @property
    def missing(self) -> list[str]:
        """Topics that have not said anything yet."""
        known = {"gripper/state": self.gripper, "planning_scene": self.scene, "joint_states": self.tcp,
                 "motion/status": self.motion}
        return [key for key, value in known.items() if value is None]

    @property
    def scene_stamp(self) -> float:
        """Time of the newest frame that the planning scene holds [s]."""
        return self.scene.header.stamp * 1e-9 if self.scene else 0.0

    def objects(self, role: str) -> list[m.CollisionObject]:
        """Objects of the planning scene with that role."""
        return [o for o in self.scene.objects if o.role == role] if self.scene else []

    def balls(self) -> list[Target]:
        """Balls on the table according to the planning scene, reachable or not."""
        return [Target(o.id, (o.pose.position.x, o.pose.position.y, o.pose.position.z)) for o in self.objects("target")]

    def spots(self, but: Target | None, radius: float) -> Spots:
        """(x, y) of the balls on the table, without the one in work."""
        return [b.position[:2] for b in self.balls() if but is None or not same_place(b.position, but.position, radius)]

    @property
    def attached(self) -> str:
        """Id of the object in the hand according to the planning scene, or an empty string."""
        return self.scene.attached[0].object.id if self.scene and self.scene.attached else ""

    @property
    def holding(self) -> bool:
        """Whether the gripper reports something between its fingers."""
        return self.gripper is not None and self.gripper.holding


def same_place(a: Place, b: Place, radius: float) -> bool:
    """Whether two places are of one ball: two balls are never closer than their diameter."""
    return math.dist(a[:2], b[:2]) < radius


def appeared(now: Spots, before: Spots, moved: float) -> bool:
    """Whether something stands now where nothing stood before; what went away is in nobody's way."""
    return any(all(math.dist(p, q) > moved for q in before) for p in now)
