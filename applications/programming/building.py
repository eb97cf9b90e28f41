"""What steps build their stages with: what is known at their beginning, and stages with the speed of the step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from applications.programming.model import BaseStep, Motion, Target
from applications.programming.targets import Array, Cell, StepProblem
from common import messages as m
from common.robot.transforms import pose_to_matrix
from common.tasks import stages as engine
from common.tasks.palletizing import Pattern
from common.tasks.stages import Cycle, Stage, View, place_of

if TYPE_CHECKING:
    from applications.programming.flow import Position

RUNNING = "RUNNING"
NEAR = 0.2  # [m] from the tool: objects that the gripper may touch when it moves straight back


@dataclass(eq=False)
class StepCycle(Cycle):
    """The stages of one execution of a step."""

    position: Position = ()
    left: int = 0  # stages that have not ended


@dataclass(eq=False)
class ProgramMove(engine.Move):
    """A motion with the speed of its step."""

    speed: float | None = field(default=None, kw_only=True)
    planner: str = field(default="", kw_only=True)


@dataclass(frozen=True)
class Outlook:
    """What is known, or expected, at the beginning of a step."""

    T_world_tcp: Array | None
    holding: bool
    object: str = ""  # id of what is held, in the planning scene
    pose: m.Pose | None = None  # of it in the tool frame, while the planning scene does not have it attached yet
    width: float | None = None  # between the fingers [m]

    @classmethod
    def of(cls, view: View) -> Outlook:
        """Return what is known now."""
        return cls(None if view.tcp is None else pose_to_matrix(view.tcp), view.holding, view.attached,
                   width=view.gripper.width if view.gripper is not None else None)


@dataclass(frozen=True)
class Repeated:
    """How far a step came before it was interrupted."""

    reached: str  # name of its last stage that ended
    held: bool  # whether the gripper held something at its beginning


@dataclass(frozen=True)
class Built:
    """The stages of a step, and what is expected after them. `known`: what follows may be built already."""

    stages: list[Stage]
    after: Outlook
    known: bool = True


@dataclass
class Builder:
    """Builds the stages of one step.

    Attributes:
        cell: with its robot.
        poses: of the program.
        speed: of steps without one.
        before: what is known at the beginning.
        view: with the planning scene.
        cycle: of all stages.
        repeated: how far the step came before it was interrupted.
        patterns: places of items that are not to be picked.
    """

    cell: Cell
    poses: Mapping[str, Target]
    speed: float | None
    before: Outlook
    view: View
    cycle: StepCycle = field(default_factory=StepCycle)
    repeated: Repeated | None = None
    patterns: Sequence[Pattern] = ()

    def build(self, step: BaseStep) -> Built:
        """Return the stages of a step. Raises StepProblem."""
        if self.repeated is not None and self.repeated.held and not self.before.holding and isinstance(step, Motion):
            raise StepProblem("what the gripper held is lost")
        made = step.stages(self)
        self.cycle.left = len(made.stages)
        return made

    def built(self, stages: Sequence[Stage], T: Array | None = None) -> Built:
        """Return stages after which only the pose (4, 4) of the tool is another one; default: the same."""
        return Built(list(stages), self.before if T is None else replace(self.before, T_world_tcp=T))

    def resolve(self, target: Target, start: Array | None = None) -> tuple[m.JointGoal | m.PoseGoal, Array]:
        """Return the goal of a target and the pose there; relative ones begin at `start`, by default that of the step.

        Raises:
            StepProblem: the pose is unknown, or has another number of joints.
        """
        return self.cell.resolve(target, self.poses, self.before.T_world_tcp if start is None else start)

    def motion(self, step: BaseStep, name: str, goal: m.AnyGoal, *, straight: bool = False,
               carried: Outlook | None = None) -> ProgramMove:
        """Return a motion of a step; `carried`: what is held then, by default as at the beginning."""
        carried = carried or self.before
        return ProgramMove(
            name, RUNNING, self.cycle, goal=goal, straight=straight, carries=carried.holding, attach=carried.object,
            attach_pose=carried.pose, speed=getattr(step, "speed", None) or self.speed,
            requires=getattr(step, "requires", {}), touches=self.fingers_on(self.objects(getattr(step, "touch", ()))))

    def objects(self, names: Sequence[str]) -> list[m.CollisionObject]:
        """Return the objects with these ids or classes."""
        found = self.view.scene.objects if self.view.scene else []
        return [each for each in found if each.id in names or (each.kind and each.kind in names)]

    def near(self, T: Array) -> list[m.CollisionObject]:
        """Return the movable objects near a pose (4, 4) of the tool."""
        return [each for role in ("target", "contained") for each in self.view.objects(role)
                if math.dist(place_of(each.pose), T[:3, 3]) < NEAR]

    def fingers_on(self, things: Sequence[m.CollisionObject]) -> list[tuple[str, str]]:
        """Return the pairs that may touch when the fingers touch objects."""
        links = self.cell.gripper.links if self.cell.gripper is not None else []
        return [(link, thing.id) for link in links for thing in things]
