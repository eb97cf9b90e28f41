"""From a step of a program to the stages of the task engine."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from applications.programming.flow import PlaceOnPallet, Position
from applications.programming.model import (
    DOWN,
    Approach,
    BaseStep,
    Force,
    Grip,
    Insert,
    Motion,
    Move,
    Output,
    Pick,
    Place,
    Python,
    Retreat,
    Target,
    Through,
    Until,
    Wait,
)
from applications.programming.targets import Cell, NotSeen, StepProblem, backed, pose_goal
from common import messages as m
from common.robot.transforms import invert, matrix_to_pose, pose_to_matrix, rpy_to_matrix, tool_down, transform
from common.tasks import stages as engine
from common.tasks.force import ForceMove, MoveUntil
from common.tasks.force import Insert as InsertMove
from common.tasks.handling import DROP, grasp_directions, height_of
from common.tasks.palletizing import Pattern, slot_at
from common.tasks.signals import Output as OutputStage
from common.tasks.signals import WaitFor
from common.tasks.stages import Cycle, Stage, View, place_of

Array = NDArray[np.float64]
RUNNING = "RUNNING"
NEAR = 0.2  # [m] from the tool: objects that the gripper may touch when it moves straight back
SEQUENCE = "sequence"  # planner of motions through several targets
INSERT_ROOM = 0.02  # [m] above the hole, where an insertion starts at most
ROOM = 0.02  # [m] by which the fingers open wider than the object


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


class Builder:
    """Builds the stages of one step."""

    def __init__(self, cell: Cell, poses: Mapping[str, Target], speed: float | None, before: Outlook, view: View,
                 cycle: StepCycle, repeated: Repeated | None = None, patterns: Sequence[Pattern] = ()) -> None:
        """Build for a program.

        Args:
            cell: with its robot.
            poses: of the program.
            speed: of steps without one.
            before: what is known at the beginning.
            view: with the planning scene.
            cycle: of all stages.
            repeated: how far the step came before it was interrupted.
            patterns: places of items that are not to be picked.
        """
        self.cell, self.poses, self.speed, self.before, self.view = cell, poses, speed, before, view
        self.cycle, self.repeated, self.patterns = cycle, repeated, patterns

    def build(self, step: BaseStep) -> Built:
        """Return the stages of a step.

        Raises:
            StepProblem: it cannot be done.
        """
        lost = self.repeated is not None and self.repeated.held and not self.before.holding
        if lost and isinstance(step, Motion):
            raise StepProblem("what the gripper held is lost")
        made = BUILDERS[type(step)](self, step)
        self.cycle.left = len(made.stages)
        return made

    # --- steps ---------------------------------------------------------------------------------------------------

    def _move(self, step: Move) -> Built:
        goal, T = self.cell.resolve(step.to, self.poses, self.before.T_world_tcp)
        if step.straight and isinstance(goal, m.JointGoal):
            goal = pose_goal(T)
        return self._moved([self._motion(step, step.id, goal, straight=step.straight)], T)

    def _through(self, step: Through) -> Built:
        T, items = self.before.T_world_tcp, list[m.SequenceItem]()
        for target in step.points:
            goal, T = self.cell.resolve(target, self.poses, T)
            if step.straight:
                goal = pose_goal(T)
            items.append(m.SequenceItem(goal=goal, straight=step.straight, blend_radius=step.blend))
        if not step.blend:
            return self._moved([
                self._motion(step, f"{step.id} {number} of {len(items)}", item.goal, straight=step.straight)
                for number, item in enumerate(items, 1)], T)
        items[-1] = items[-1].model_copy(update={"blend_radius": 0.0})
        motion = self._motion(step, step.id, m.SequenceGoal(items=items))
        motion.planner = SEQUENCE
        return self._moved([motion], T)

    def _approach(self, step: Approach) -> Built:
        _, T = self.cell.resolve(step.to, self.poses, self.before.T_world_tcp)
        return self._moved([
            self._motion(step, f"{step.id} before", pose_goal(backed(T, step.distance, step.axis))),
            self._motion(step, step.id, pose_goal(T), straight=True)], T)

    def _retreat(self, step: Retreat) -> Built:
        start = self.before.T_world_tcp
        if start is None:
            raise StepProblem("the pose of the tool is not known")
        T = backed(start, step.distance, step.axis)
        motion = self._motion(step, step.id, pose_goal(T), straight=True)
        motion.touches = [*motion.touches, *self._fingers_on(self._near(start))]
        return self._moved([motion], T)

    def _grip(self, step: Grip) -> Built:
        width = self.width_of(step)
        stage = engine.Grip(step.id, RUNNING, self.cycle, width=width, effort=step.force, mass=step.mass,
                            holds=step.holds, expected_width=step.expected_width, width_tolerance=step.width_tolerance)
        free = not self.before.holding and step.holds is not True and width >= (self.before.width or 0.0)
        return Built([stage], replace(self.before, width=width), known=free)

    def width_of(self, step: Grip) -> float:
        """Return the width that a step commands [m]."""
        gripper = self.cell.require_gripper()
        width = {"open": gripper.max_width, "close": 0.0}.get(str(step.width), step.width)
        assert isinstance(width, float)
        if width > gripper.max_width:
            raise StepProblem(f"width: {width:g} m is more than the {gripper.max_width:g} m of the open gripper")
        return width

    def _output(self, step: Output) -> Built:
        return Built([OutputStage(step.signal, step.value, name=step.id, state=RUNNING, cycle=self.cycle)], self.before)

    def _wait(self, step: Wait) -> Built:
        until = step.until
        stages = [] if until is None else [WaitFor(
            until.signal, until.value, step.timeout, above=until.above, below=until.below, name=step.id, state=RUNNING,
            cycle=self.cycle)]
        return Built(list(stages), self.before)

    def _python(self, step: BaseStep) -> Built:
        return Built([], self.before, known=False)

    def _pick(self, step: Pick) -> Built:
        gripper = self.cell.require_gripper()
        if self.before.holding:
            return self._after_grasp(step)
        thing = self._choose(step)
        yaw, width = grasp_directions(thing, gripper.closing_axis, gripper.max_width)[0]
        x, y, z = place_of(thing.pose)
        T = tool_down(x, y, self.cell.grasp.height(z), yaw)
        above = backed(T, self.cell.grasp.approach_clearance, "world")
        opening = gripper.max_width if width is None else min(width + ROOM, gripper.max_width)
        held = matrix_to_pose(invert(T) @ pose_to_matrix(thing.pose))
        after = Outlook(above, holding=True, object=thing.id, pose=held, width=width)
        lift = self._motion(step, "lift", pose_goal(above), straight=True, carried=after)
        descend = self._motion(step, "descend", pose_goal(T), straight=True)
        descend.touches = self._fingers_on([thing])
        return Built([
            engine.Grip("open", RUNNING, self.cycle, width=opening),
            self._motion(step, "pre-grasp", pose_goal(above)), descend,
            engine.Grip("close", RUNNING, self.cycle, width=0.0, holds=True, effort=step.force or thing.grip_effort,
                        mass=thing.mass, expected_width=width, width_tolerance=self.cell.width_tolerance),
            lift], after)

    def _after_grasp(self, step: Pick) -> Built:
        """Return the end of a pick that was interrupted after the fingers had closed."""
        if self.repeated is None or self.before.T_world_tcp is None:
            raise StepProblem("the gripper already holds something")
        above = backed(self.before.T_world_tcp, self.cell.grasp.approach_clearance, "world")
        return self._moved([self._motion(step, "lift", pose_goal(above), straight=True)], above)

    def _place(self, step: Place) -> Built:
        return self._placed(step, step.distance, self.cell.resolve(step.at, self.poses, self.before.T_world_tcp)[1])

    def _place_on_pallet(self, step: PlaceOnPallet) -> Built:
        T_slot = pose_to_matrix(step.slot)
        held = self.before.pose or next(
            (each.object.pose for each in (self.view.scene.attached if self.view.scene else [])), None)
        if held is not None:
            turns = [T_slot @ transform(rpy_to_matrix(0, 0, turn), (0, 0, 0)) @ invert(pose_to_matrix(held))
                     for turn in (0.0, math.pi)]
            T = min(turns, key=lambda T: -T[0, 0])  # the tool turns less
        else:
            yaw = math.remainder(math.atan2(T_slot[1, 0], T_slot[0, 0]), math.pi)
            T = transform(rpy_to_matrix(DOWN[0], DOWN[1], yaw), T_slot[:3, 3] + (0.0, 0.0, step.height))
        return self._placed(step, step.distance, backed(T, DROP, "world"))

    def _placed(self, step: Place | PlaceOnPallet, distance: float, T: Array) -> Built:
        gripper, before = self.cell.require_gripper(), self.before
        above = backed(T, distance, "world")
        width = gripper.max_width if before.width is None else min(before.width + ROOM, gripper.max_width)
        after = Outlook(above, holding=False, width=width)
        leave = self._motion(step, "leave", pose_goal(above), straight=True, carried=after)
        leave.touches = self._fingers_on(self._near(T)) + [
            (link, before.object) for link in gripper.links if before.object]
        if not before.holding:
            if self.repeated is None or self.repeated.reached not in ("lower", "release"):
                raise StepProblem("the gripper holds nothing to place")
            return Built([leave], after)  # it was interrupted after the fingers had opened
        lower = self._motion(step, "lower", pose_goal(T), straight=True)
        if before.object:
            lower.touches = [(before.object, each.id) for each in self._near(T)]
        return Built([
            self._motion(step, "across", pose_goal(above)), lower,
            engine.Grip("release", RUNNING, self.cycle, width=width, holds=False, carries=True), leave], after)

    def _until(self, step: Until) -> Built:
        return self._by_force(MoveUntil(
            step.id, RUNNING, self.cycle, direction=step.direction, frame=step.frame, force=step.force,
            max_distance=step.max_distance, fields={"speed": step.tool_speed}), step)

    def _insert(self, step: Insert) -> Built:
        return self._by_force(InsertMove(
            step.id, RUNNING, self.cycle, direction=step.direction, frame=step.frame, force=step.force,
            max_distance=step.max_distance or step.depth + INSERT_ROOM, fields={"depth": step.depth}), step)

    def _by_force(self, move: ForceMove, step: Force) -> Built:
        held, things = self.before.object, self._touched(step.touch)
        move.carries, move.attach, move.attach_pose = self.before.holding, held, self.before.pose
        move.touches = self._fingers_on(things) + [(held, thing.id) for thing in things if held]
        return Built([move], replace(self.before, T_world_tcp=None), known=False)

    # --- parts of steps --------------------------------------------------------------------------------------------

    def _motion(self, step: BaseStep, name: str, goal: m.AnyGoal, *, straight: bool = False,
                carried: Outlook | None = None) -> ProgramMove:
        carried = carried or self.before
        speed = getattr(step, "speed", None)
        return ProgramMove(
            name, RUNNING, self.cycle, goal=goal, straight=straight, carries=carried.holding, attach=carried.object,
            attach_pose=carried.pose, speed=speed or self.speed, requires=getattr(step, "requires", {}),
            touches=self._fingers_on(self._touched(getattr(step, "touch", ()))))

    def _moved(self, motions: list[ProgramMove], T: Array | None) -> Built:
        return Built(list(motions), replace(self.before, T_world_tcp=T))

    def _touched(self, names: Sequence[str]) -> list[m.CollisionObject]:
        objects = self.view.scene.objects if self.view.scene else []
        return [each for each in objects if each.id in names or (each.kind and each.kind in names)]

    def _near(self, T: Array) -> list[m.CollisionObject]:
        """Return the movable objects near a pose (4, 4) of the tool."""
        at = tuple(float(value) for value in T[:3, 3])
        return [each for role in ("target", "contained") for each in self.view.objects(role)
                if math.dist(place_of(each.pose), at) < NEAR]

    def _fingers_on(self, things: Sequence[m.CollisionObject]) -> list[tuple[str, str]]:
        links = self.cell.gripper.links if self.cell.gripper is not None else []
        return [(link, thing.id) for link in links for thing in things]

    def _choose(self, step: Pick) -> m.CollisionObject:
        """Return the fitting object nearest to the tool; of two that are equally near the higher one."""
        fitting = [each for each in self.view.objects(step.role)
                   if step.kind in ("", each.kind) and step.object in ("", each.id)
                   and not any(slot_at(pattern, place_of(each.pose)) for pattern in self.patterns)]
        if not fitting:
            seen = sorted({each.kind or each.id for each in self.view.objects(step.role)})
            what = step.object or step.kind or "object"
            raise NotSeen(f"no {what} with role {step.role} is seen; seen: {', '.join(seen) or 'nothing'}")
        start = self.before.T_world_tcp
        at = (0.0, 0.0) if start is None else (float(start[0, 3]), float(start[1, 3]))
        return min(fitting, key=lambda each: (round(math.dist(place_of(each.pose)[:2], at), 3), -height_of(each)))


BUILDERS: dict[type[BaseStep], Callable[[Builder, Any], Built]] = {
    Move: Builder._move, Through: Builder._through, Approach: Builder._approach, Retreat: Builder._retreat,
    Grip: Builder._grip, Output: Builder._output, Wait: Builder._wait, Pick: Builder._pick, Place: Builder._place,
    PlaceOnPallet: Builder._place_on_pallet, Python: Builder._python,
    Until: Builder._until, Insert: Builder._insert}
