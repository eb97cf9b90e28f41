"""What a task asks for: moves and gripper commands in a row, and the requests that carry them out."""

from __future__ import annotations

from dataclasses import dataclass, field

from common import messages as m


@dataclass
class Target:
    """An object that was seen: its place [m] in world, and its track id in the planning scene."""

    id: str
    position: tuple[float, float, float]


@dataclass
class Move:
    """A motion of the arm; `trajectory` is there once it was planned."""

    name: str
    state: m.TaskState
    goal: m.PoseGoal | m.JointGoal
    straight: bool = False
    touches_target: bool = False
    carries: bool = False
    allowed: list[tuple[str, str]] = field(default_factory=list)
    trajectory: m.JointTrajectory | None = None
    planned_around: list[tuple[float, float]] = field(default_factory=list)


@dataclass
class Grip:
    """A motion of the fingers to a width [m]."""

    name: str
    state: m.TaskState
    width: float


Stage = Move | Grip


@dataclass
class Cycle:
    """Taking one object to the container: its stages, and the yaws that are still to be tried."""

    target: Target
    yaws: list[float] = field(default_factory=list)
    begun: bool = False
    errors: list[str] = field(default_factory=list)


Command = m.PlanRequest | m.ExecuteRequest | m.GripperCommand | m.StopRequest


@dataclass
class View:
    """What the task knows at an instant: only what was perceived or reported.

    Times are cell time [s]. `targets` were validated in the frame of `targets_stamp`; `scene_stamp` is that of the
    newest frame in the planning scene. `tcp` is (x, y, z) of the tool centre point in world [m].
    """

    now: float
    targets: list[tuple[float, float, float]] = field(default_factory=list)
    targets_stamp: float = 0.0
    scene: m.PlanningScene | None = None
    gripper: m.GripperState | None = None
    motion: m.MotionStatus | None = None
    tcp: tuple[float, float, float] | None = None

    @property
    def scene_stamp(self) -> float:
        """Time of the newest frame that the planning scene holds [s]."""
        return self.scene.header.stamp * 1e-9 if self.scene else 0.0

    def objects(self, role: str) -> list[m.CollisionObject]:
        """Objects of the planning scene with that role."""
        return [o for o in self.scene.objects if o.role == role] if self.scene else []

    @property
    def attached(self) -> str:
        """Id of the object in the hand according to the planning scene, or an empty string."""
        return self.scene.attached[0].object.id if self.scene and self.scene.attached else ""

    @property
    def holding(self) -> bool:
        """Whether the gripper reports something between its fingers."""
        return self.gripper is not None and self.gripper.holding
