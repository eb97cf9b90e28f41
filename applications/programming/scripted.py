"""Steps in an exported script: each is carried out by calls of the blocking client, with the stages of the program."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from applications.programming.building import Builder, Outlook, ProgramMove
from applications.programming.cursor import FAILED, SUCCEEDED
from applications.programming.functions import call_function
from applications.programming.handling import Palletize
from applications.programming.model import STEPS, BaseStep, Condition, Target
from applications.programming.offline import cell_with, load_single
from applications.programming.steps import Python, Wait
from applications.programming.targets import Cell, NotSeen, StepProblem
from common import messages as m
from common.client.operator_motion import MotionFailed
from common.config import check
from common.errors import ZencellError
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.tasks.force import ForceMove
from common.tasks.palletizing import Pattern
from common.tasks.signals import Output, WaitFor, condition_met
from common.tasks.stages import MISSES, Grip, Stage, View
from common.time_source import monotonic


@lru_cache
def _config(cell: str) -> Cell:
    loaded = load_single(cell)
    return cell_with(loaded, RobotModel.load(loaded.robot))


class Steps:
    """Does steps in a cell, with a method for each kind and its fields: `do.move(to="home", speed=0.3)`.

    Attributes:
        outcome: of the step before: succeeded, failed, or what a Python function returned.
    """

    def __init__(self, cell: Any, config: str, *, speed: float | None = None,
                 poses: Mapping[str, Any] | None = None) -> None:
        """Do steps in a blocking `cell` of a configuration; speed and poses are those of a program."""
        self._cell, self._config, self._speed = cell, _config(config), speed
        self._poses = {name: check(Target, target) for name, target in (poses or {}).items()}
        self._patterns: list[Pattern] = []  # that are filled now
        self.outcome = SUCCEEDED

    def __getattr__(self, kind: str) -> Any:
        """Return the method of a kind of step."""
        if kind not in STEPS:
            raise AttributeError(kind)
        return partial(self._do_kind, kind)

    def met(self, **condition: Any) -> bool:
        """Return whether a condition holds."""
        wanted = check(Condition, condition)
        if wanted.signal:
            return condition_met(self._cell.io.read(wanted.signal), wanted.value, wanted.above, wanted.below)
        if wanted.holding is not None:
            return bool(self._cell.gripper.state().holding is wanted.holding)
        return self.outcome == wanted.outcome

    def palletize(self, **fields: Any) -> Iterator[int]:
        """Yield the number of each place of a pallet, then place there what the gripper holds."""
        step = check(Palletize, {**fields, "steps": [{"step": "wait", "seconds": 0}]})
        self._patterns.append(step.pattern)
        for number in range(step.places):
            yield number
            self._do(step.placing(number))
        self._patterns.pop()

    def _do_kind(self, kind: str, /, **fields: Any) -> None:
        self._do(check(STEPS[kind], {"id": kind, **fields}))

    def _do(self, step: BaseStep) -> None:
        try:
            self.outcome = self._outcome(step)
        except ZencellError:
            if step.on_failure == "stop":
                raise
            self.outcome = FAILED

    def _outcome(self, step: BaseStep) -> str:
        if isinstance(step, Python):
            outcome, problem = asyncio.run(call_function(step, Path.cwd()))
            if problem:
                raise StepProblem(problem)
            return outcome or SUCCEEDED
        if isinstance(step, Wait) and step.seconds is not None:
            time.sleep(step.seconds)
        for stage in self._stages(step):
            self._carry_out(stage)
        return SUCCEEDED

    def _stages(self, step: BaseStep) -> list[Stage]:
        ends = monotonic() + getattr(step, "timeout", 0.0)
        while True:
            cell = self._cell
            view = View(0.0, scene=cell.planning_scene(), q=cell.arm.joints().tolist(),
                        gripper=cell.gripper.state() if self._config.gripper is not None else None,
                        tcp=matrix_to_pose(cell.arm.pose()))
            try:
                return Builder(self._config, self._poses, self._speed, Outlook.of(view), view,
                               patterns=self._patterns).build(step).stages
            except NotSeen:
                if monotonic() > ends:
                    raise
            time.sleep(0.1)

    def _carry_out(self, stage: Stage) -> None:
        cell = self._cell
        if isinstance(stage, ForceMove):
            move = {"until": cell.arm.move_until, "insert": cell.arm.insert}[stage.kind]
            move(force=stage.force, direction=stage.direction, frame=stage.frame, max_distance=stage.max_distance,
                 touch={thing for _, thing in stage.touches}, **stage.fields)
        elif isinstance(stage, ProgramMove):
            for name, value in stage.requires.items():
                cell.io.wait(name, value)
            known = any(each.object.id == stage.attach for each in cell.planning_scene().attached)
            cell.arm.move(
                stage.goal, straight=stage.straight, speed=stage.speed, planner=stage.planner,
                allowed_collisions=stage.touches, attach=stage.attach if stage.carries else "",
                attach_pose=None if known else stage.attach_pose, release=not stage.carries)
        elif isinstance(stage, Grip):
            state = cell.gripper.move(stage.width, stage.effort, mass=stage.mass, expected=stage.expected_width,
                                      tolerance=stage.width_tolerance)
            _require(stage, state)
        elif isinstance(stage, Output):
            cell.io.set(stage.signal, stage.value)
        elif isinstance(stage, WaitFor):
            cell.io.wait(stage.signal, stage.value, stage.timeout, above=stage.above, below=stage.below)


def _require(stage: Grip, state: m.GripperState) -> None:
    if stage.holds is not None and (state.holding is not stage.holds or (stage.holds and state.outcome in MISSES)):
        raise MotionFailed("grasp", state.message or (
            f"the gripper holds {'nothing' if stage.holds else 'something'}"))
