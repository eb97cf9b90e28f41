"""Plan a program without motion: what cannot run, and how long it takes. Requests and answers pass through a generator.

Unknown conditions are assumed: an `if` by a signal does `then`, a loop while a signal has a value turns once.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import replace

from applications.programming.building import Builder, Outlook, ProgramMove
from applications.programming.files import ProgramFile
from applications.programming.flow import Flow, Position, Undecided
from applications.programming.handling import Pick
from applications.programming.model import BaseStep, Condition, walk
from applications.programming.steps import If, Wait
from applications.programming.targets import Cell, NotSeen
from applications.programming.topics import Rehearsal, RehearsedStep
from common import messages as m
from common.config import Io
from common.errors import ConfigError, UnknownName, ZencellError
from common.robot.transforms import matrix_to_pose, pose_to_matrix
from common.tasks import stages as engine
from common.tasks.signals import WaitFor, check_condition
from common.tasks.stages import View

MOST = 1000  # executed steps
Planning = Generator[m.PlanRequest, m.PlanResponse, None]


def static_problems(file: ProgramFile, cell: Cell, io: Io) -> Iterator[tuple[BaseStep, str]]:
    """Yield the steps of a file that cannot run in a cell, whatever happens before: poses, signals, functions."""
    for place, step in walk(file.program.steps):
        for field, problem in _wrong(step, file, cell, io):
            yield step, f"{place}.{field}: {problem}"


def _problem_of_goal(response: m.PlanResponse) -> str:
    """Return why the goal of a plan cannot be reached from any start; empty: it may be."""
    if response.error == "out_of_reach":
        return response.message
    return next((each.message for each in response.attempts
                 if each.error in ("no_ik", "goal_in_collision") and each.waypoint is None), "")


def _wrong(step: BaseStep, file: ProgramFile, cell: Cell, io: Io) -> Iterator[tuple[str, str]]:
    for key, target in step.targets():
        if target.by is None:
            try:
                cell.resolve(target, file.program.poses, None)
            except ZencellError as error:
                yield key, str(error)
    for key, name in step.keys().items():
        try:
            value = getattr(step, name)
            if isinstance(value, Condition) and value.signal:
                signal = io.find(value.signal, output=False)
                check_condition(value.signal, signal.range is not None, value.above, value.below)
            elif key == "requires":
                for each in value:
                    io.find(each, output=False)
            elif key == "signal":
                io.find(value, output=True).checked(value, getattr(step, "value", True))
        except (UnknownName, ConfigError) as error:
            yield key, str(error)
    yield from step.problems(cell, file.path.parent)


class Rehearser:
    """Goes through a program as the task does, with planned motions only."""

    def __init__(self, flow: Flow, cell: Cell, io: Io, view: View, planning_time: float) -> None:
        """Begin at the state of a view, which has a planning scene, joint positions and the pose of the tool."""
        assert view.q is not None and view.scene is not None
        self.flow, self.cell, self.io, self._planning_time = flow, cell, io, planning_time
        self.result = Rehearsal(program=flow.main, state="running")
        self._q, self.scene, self._view = list(view.q), view.scene, view
        self._now = Outlook.of(view)
        self.planned = 0
        self._turned: dict[Position, bool] = {}  # loops by condition that have turned once
        self._visited: set[str] = set()
        self._guessed = False  # whether a condition was assumed
        self._lost = ""  # step after which the state of the robot is not known
        self._wrong: Mapping[str, str] = {
            step.id: problem for file in flow.files.values() for step, problem in static_problems(file, cell, io)}

    def run(self, start: Position, *, everything: bool = False) -> Planning:
        """Yield plan requests, and be sent the responses; `result` grows with each step.

        Args:
            start: first step.
            everything: also plan steps that are not reached, such as those of `else`, each from the state at the start.
        """
        begin = self._q, self.scene, self._now
        position = start
        while position and len(self.result.steps) < MOST:
            try:
                position = self.flow.leaf(position, self._assume)
            except Undecided:  # there is nothing to do
                break
            if position:
                yield from self._rehearse(self.flow.step(position), self.flow.file(position))
                position = self.flow.after(position)
            if endless := self.flow.endless(position):
                self.result.message = f"{endless} repeats without end: one turn is planned"
                break
        if len(self.result.steps) >= MOST:
            self.result.message = f"only the first {MOST} steps are planned"
        if everything:
            for file in self.flow.files.values():
                for step in file.steps.values():
                    if step.id not in self._visited and (not type(step).BODIES or step.id in self._wrong):
                        (self._q, self.scene, self._now), self._lost = begin, ""
                        yield from self._rehearse(
                            step, file, "is not reached in the dry run: planned from the state at the start")
        failed = any(each.problem for each in self.result.steps)
        self.result.state, self.result.step = "failed" if failed else "done", ""

    def _rehearse(self, step: BaseStep, file: ProgramFile, assumed: str = "") -> Planning:
        """Plan one step and add it to the result."""
        self._visited.add(step.id)
        self.result.step = step.id
        item = RehearsedStep(program=file.name, step=step.id, kind=step.step)
        certain = False  # the problem does not depend on the start of the step
        if problem := self._wrong.get(step.id, ""):
            item.problem, self._lost = problem, step.id
            certain = True
        elif step.UNKNOWN:
            item.unknown, self._lost = step.UNKNOWN, self._lost or (step.id if step.ENDS_ANYWHERE else "")
        elif isinstance(step, Wait) and step.seconds is not None:
            item.seconds = step.seconds
        else:
            certain = yield from self._plan(step, file, item)
        if not certain:
            after = f"begins after {self._lost}, whose end is not known" if self._lost not in ("", step.id) else ""
            guess = "a condition before is assumed" if self._guessed and item.problem else ""
            item.unknown = "; ".join(each for each in (item.unknown, assumed, after, guess) if each)
        self.result.seconds += item.seconds or 0.0
        self.result.steps.append(item)

    def _plan(
        self, step: BaseStep, file: ProgramFile, item: RehearsedStep,
    ) -> Generator[m.PlanRequest, m.PlanResponse, bool]:
        """Plan the motions of a step; return whether a problem does not depend on its start."""
        main = self.flow.files[self.flow.main].program
        view = replace(self._view, scene=self.scene)
        try:
            speed = file.program.speed or main.speed
            built = Builder(self.cell, file.program.poses, speed, self._now, view).build(step)
        except NotSeen as error:
            item.unknown, self._lost = str(error), self._lost or step.id
            self._now = replace(self._now, holding=isinstance(step, Pick))
            return False
        except ZencellError as error:
            item.problem, self._lost = str(error)[:500], self._lost or step.id
            item.unknown = "depends on the state before the step"
            return False
        seconds, unknown, certain = 0.0, "", False
        for stage in built.stages:
            if isinstance(stage, ProgramMove):
                response = yield self._request(stage)
                if response.trajectory is None or not response.ok:
                    of_goal = _problem_of_goal(response)
                    item.problem = (of_goal or response.message).removeprefix(f"{stage.name}: ")[:500]
                    self._lost = self._lost or step.id
                    certain = bool(of_goal) and {target.by is None for _, target in step.targets()} == {True}
                    if isinstance(goal := stage.goal, m.JointGoal):
                        self._q = list(goal.positions or self.cell.robot.config.named_poses[goal.named])
                    break
                seconds += response.trajectory.points[-1].time_from_start
                self._q = list(response.trajectory.points[-1].positions)
            elif isinstance(stage, engine.Grip):
                assert self.cell.gripper is not None
                before = self._now.width if self._now.width is not None else 0.0
                seconds += self.cell.gripper.least_time(abs(before - stage.width_after(before)))
                self._now = replace(self._now, width=stage.width_after(before))
                if stage.name == "release":
                    self._release()
            elif isinstance(stage, WaitFor):
                unknown = f"the wait for {stage.condition}"
        item.seconds, item.unknown = (None if unknown else seconds), unknown
        self._now = replace(built.after, T_world_tcp=self.cell.robot.fk(self._q))
        return certain

    def _request(self, move: ProgramMove) -> m.PlanRequest:
        self.planned += 1
        return m.PlanRequest(
            id=f"dry-run-{id(self)}-{self.planned}", stage=move.name, start=self._q, goal=move.goal,
            straight=move.straight, allowed_collisions=move.touches, attach=move.attach if move.carries else "",
            attach_pose=move.attach_pose, release=not move.carries, planning_time=self._planning_time,
            velocity_scaling=move.speed, planner=move.planner, gripper_width=self._width())

    def _width(self) -> float | None:
        gripper = self.cell.gripper
        if gripper is None or not gripper.joints or self._now.width is None:
            return None
        return min(max(self._now.width, 0.0), gripper.max_width)

    def _release(self) -> None:
        """Leave the held object in the scene where it is released; it is not picked again."""
        if not self._now.object or self._now.pose is None:
            return
        T = self.cell.robot.fk(self._q) @ pose_to_matrix(self._now.pose)
        objects = [each.model_copy(update={"pose": matrix_to_pose(T), "role": "contained"})
                   if each.id == self._now.object else each for each in self.scene.objects]
        self.scene = self.scene.model_copy(update={"objects": objects})

    def _assume(self, condition: Condition, position: Position) -> bool:
        step, self._guessed = self.flow.step(position), True
        if condition.holding is not None and isinstance(step, If):
            return self._now.holding is condition.holding
        if condition.outcome and isinstance(step, If):
            return condition.outcome == "succeeded"
        first = not self._turned.get(position, False)
        self._turned[position] = first
        return first or isinstance(step, If)
