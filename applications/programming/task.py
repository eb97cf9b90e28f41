"""Runs a program on the task engine: one step after the other, with the motions of the next ones planned ahead.

The position of a step is on disk before the step begins. After a restart in the middle of a program, the task halts at
this step until the operator lets it continue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pydantic import BaseModel

from applications.programming.building import Builder, Built, Outlook, ProgramMove, Repeated, StepCycle
from applications.programming.cursor import FAILED, SUCCEEDED, Cursor, Progress
from applications.programming.files import BadProgram, load_program, path_of
from applications.programming.flow import Position, Undecided
from applications.programming.handling import Pick
from applications.programming.model import Condition
from applications.programming.settings import Config
from applications.programming.steps import Python, Wait
from applications.programming.targets import Cell, NotSeen
from applications.programming.topics import ProgramStatus
from common import messages as m
from common.errors import ConfigError, ZencellError
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix
from common.saved_poses import load_poses, poses_file
from common.tasks.engine import Task
from common.tasks.signals import LONGEST_COUNTED, condition_met
from common.tasks.stages import Command, Grip, Move, Stage, View

AHEAD = 3  # steps whose motions are planned before they begin
ENDED = ("DONE", "ERROR")


@dataclass(frozen=True, eq=False)
class PythonCall:
    """A function to call."""

    step: Python
    folder: Path


class ProgramTask(Task[View]):
    """Executes the steps of the loaded program."""

    p: Config
    status: ProgramStatus

    def __init__(self, config: Config, status: ProgramStatus, prefix: str, speed: float = 1.0) -> None:
        """Start without a program; the arguments are those of `Task`."""
        super().__init__(config, status, prefix, speed)
        self.at = Cursor(status)
        self.cell = Cell(RobotModel.load(config.robot), config.robot.gripper, config.grasp,
                         lambda: load_poses(poses_file(config.run.cell)))
        if config.program:
            try:
                self.at.load(load_program(path_of(config.folder, config.program)))
            except BadProgram as error:
                raise ConfigError("program", ..., str(error)) from None
        self.call: PythonCall | None = None  # to be carried out by the service
        self._queued: list[tuple[StepCycle, Built]] = []  # steps whose stages are in the queue, the current one first
        self._attempts, self._spent, self._counted = 0, 0.0, 0.0
        self._not_ahead: Position | None = None  # the step during which nothing more is planned ahead
        self._halted = ""  # last reason in the status message

    # --- commands of the operator, besides those of each task ----------------------------------------------------

    @property
    def is_active(self) -> bool:
        """Whether a step is being carried out."""
        status = self.status
        return self.running is not None or (status.state == "RUNNING" and status.started and not status.halted)

    def go_to(self, step: str = "") -> None:
        """Make a step of the program the next one; by default the first one. Raises UnknownName and ConfigError."""
        self.at.restart(step)
        self._drop_all()
        if self.status.state in ENDED:
            self.status.state, self.status.message = "IDLE", ""

    def proceed(self, *, single: bool = False) -> None:
        """Let a halted program continue; for one step, if `single`."""
        self.at.single, self.at.passes, self.status.halted = single, single or bool(self.status.halted), ""
        if not self.at.position and self.at.flow is not None:
            self.go_to()

    def on_restart(self) -> None:
        """Begin again after the end; repeat the step that failed after an error."""
        self._attempts = 0
        if not self.at.position and self.at.flow is not None:
            self.at.restart()

    @property
    def memory(self) -> Progress:
        """Where the program is."""
        return self.at.progress

    def remember(self, memory: BaseModel) -> None:
        """Stay at the step of the process before, and let the operator decide."""
        assert isinstance(memory, Progress)
        if not memory.program or not memory.position:
            return
        path = Path(memory.program)
        try:
            self.at.load(load_program(path))
        except ZencellError as error:
            self.status.halted = f"{path.stem} was interrupted, and cannot be loaded any more: {error}"[:500]
            return
        if self.at.resume_from(memory):
            self.status.halted = (f"{path.stem} was interrupted at step {self.at.step.id}: resume repeats it (`zencell "
                                  "program resume`); or run the program from the start, or from another step")
        else:
            self.status.halted = f"{path.stem} was interrupted, and has changed since: run it, or run it from a step"

    def command(self, command: str, view: View) -> list[Command]:
        """Handle a command; a resume also lets a halted program continue."""
        if command == "resume" and self.status.halted:
            self.proceed()
        return super().command(command, view)

    # --- hooks of the engine --------------------------------------------------------------------------------------

    def step(self, view: View) -> list[Command]:
        """Follow the control flow, then let the engine work through the stages."""
        passed, self._counted = view.now - self._counted, view.now
        motion, status = view.motion, self.status
        if motion is not None and not view.missing and self.at.flow is not None and status.started and not (
                status.paused or status.halted or status.state in ENDED or motion.held or motion.stopped):
            self._follow(view, passed if 0 <= passed < LONGEST_COUNTED else 0.0)
        return super().step(view)

    def decide(self, view: View) -> None:
        """Queue the stages of the current step, and of the next ones."""
        if self.at.flow is None:
            self.status.message = "no program is loaded"
        elif self.at.position or self.status.halted:
            self._fill(view)
        elif self.status.state != "DONE":
            self.at.end()
            self.end("DONE")

    def decide_ahead(self, running: Stage, view: View) -> None:
        """Queue the stages of the next steps."""
        self._fill(view)

    def may_start(self, stage: Stage, view: View) -> bool:
        """Return whether a stage belongs to the step that has started, and whose position is on disk."""
        cycle, at = stage.cycle, self.at
        of_step = not isinstance(cycle, StepCycle) or (at.in_step and cycle.position == at.position and at.is_saved)
        return of_step and super().may_start(stage, view)

    def succeeded(self, stage: Stage, view: View) -> None:
        """End the step with its last stage."""
        cycle = stage.cycle
        if isinstance(stage, Grip):
            self.images_after = view.now
        if isinstance(cycle, StepCycle) and self._queued and self._queued[0][0] is cycle:
            self.at.reach(stage.name)
            cycle.left -= 1
            if cycle.left == 0:
                self._finish(SUCCEEDED)

    def clear(self) -> None:
        """Empty the queue. A running last stage still ends its step; any other step is repeated."""
        super().clear()
        running = self.running.stage.cycle if self.running is not None else None
        self._queued = [each for each in self._queued[:1] if each[0] is running and each[0].left == 1]
        self.at.repeated = self.at.repeated or (self.at.in_step and not self._queued)

    def fail(self, message: str, view: View, *, go_home: bool = True) -> None:
        """Repeat the step after a failure, or end it: a program never goes home by itself."""
        self._attempts += 1
        by_force = bool(self.at.position) and self.at.step.ENDS_ANYWHERE  # it began at another place
        if (self._attempts < self.p.attempts and not by_force) or not self.at.position:
            super().fail(message, view, go_home=False)
        else:
            self.status.failures += 1
            self._fail_step(message)

    def plan_failed(self, move: Move, response: m.PlanResponse, view: View) -> None:
        """Count a failure of the current step; what was planned ahead is planned again when its step begins."""
        cycle = move.cycle
        if isinstance(cycle, StepCycle) and cycle.position != self.at.position:
            current = [stage for stage in self.queue if stage.cycle is self._queued[0][0]]
            self.queue.clear()
            self.queue.extend(current)
            del self._queued[1:]
            self._not_ahead = self.at.position
        else:
            self.fail(response.message, view)

    def missed(self, stage: Grip, view: View) -> None:
        """End the step: the program decides what follows."""
        self.status.retries += 1
        self._fail_step(f"{stage.name}: {stage.problem}")

    def signal_failed(self, stage: Stage, view: View, problem: str) -> None:
        """End the step: the program decides what follows."""
        self._fail_step(problem)

    def request(self, move: Move, start: list[float], view: View) -> m.PlanRequest:
        """Return the plan request of a motion, with the speed of its step."""
        request = super().request(move, start, view)
        if isinstance(move, ProgramMove):
            request.velocity_scaling, request.planner = move.speed, move.planner
            if move.attach and view.attached == move.attach:
                request.attach_pose = None  # the planning scene has it
        return request

    def note(self, view: View) -> None:
        """Report why the program halts."""
        if self.status.halted:
            self.status.message = self.status.halted
        elif self.status.message == self._halted:
            self.status.message = ""
        self._halted = self.status.halted
        self.status.total = max(self.status.total, self.status.done + bool(self.status.step))

    # --- steps ----------------------------------------------------------------------------------------------------

    def _follow(self, view: View, passed: float) -> None:
        """Begin the next step, or continue one without stages; `passed` since the last step of the engine [s]."""
        try:
            if not self.at.in_step and self.at.advance(lambda condition, _: self._holds(condition, view)):
                self.at.begin(view.tcp, holding=view.holding)
                self._spent = 0.0
                self.status.state, self.status.message = "RUNNING", ""
        except Undecided as waits:
            self.status.message = f"{self.at.step.id} waits: {waits}"
            return
        if not self.at.in_step or not self.at.is_saved:
            return
        step = self.at.step
        self._spent += passed if not self.running else 0.0
        if isinstance(step, Wait) and step.seconds is not None and self._spent >= step.seconds:
            self._finish(SUCCEEDED)
        elif isinstance(step, Python) and self.call is None:
            self.call = PythonCall(step, self.at.file.path.parent)

    def on_result(self, call: PythonCall, outcome: str, problem: str) -> None:
        """Handle the end of a function of the user: its outcome, or why it failed."""
        if self.call is not call:
            return  # the operator has gone to another step
        self.call = None
        if problem:
            self._fail_step(problem)
        else:
            self._finish(outcome or SUCCEEDED)

    def _finish(self, outcome: str) -> None:
        if self._queued and self._queued[0][0].position == self.at.position:
            self._queued.pop(0)
        self._attempts, self._spent, self._not_ahead = 0, 0.0, None
        self.at.finish(outcome)

    def _fail_step(self, problem: str) -> None:
        """End the step with the outcome failed, or the program with an error."""
        step, where = self.at.step, self.at.file.where(self.at.step)
        self._drop_all()
        if step.on_failure == "continue":
            self.status.message = problem
            self._finish(FAILED)
            return
        self.at.repeated, self.at.in_step, self.status.outcome = True, False, FAILED
        self.end("ERROR", f"{where}: {problem.removeprefix(f'{step.id}: ')}")  # a planner names the request, too

    def _drop_all(self) -> None:
        self.clear()
        self._queued.clear()
        self.call = None

    def _holds(self, condition: Condition, view: View) -> bool:
        """Return whether a condition holds. Raises Undecided."""
        if condition.signal:
            value = view.signal(condition.signal)
            if value is None:
                raise Undecided(self._signal_problem(condition.signal, view) or f"{condition.signal} is not known")
            return condition_met(value, condition.value, condition.above, condition.below)
        if condition.holding is not None:
            return view.holding is condition.holding
        return self.status.outcome == condition.outcome

    # --- stages ---------------------------------------------------------------------------------------------------

    def _fill(self, view: View) -> None:
        """Queue the stages of the current step if it has started, and of the next ones as far as they are known."""
        if not self._queued and not (self.at.in_step and self._append(self.at.position, self._now(view), view)):
            return
        while len(self._queued) <= AHEAD and self._queued[-1][1].known and self._not_ahead != self.at.position:
            last, built = self._queued[-1]
            try:
                position = self.at.program.leaf(self.at.program.after(last.position), _undecided)
            except Undecided:
                return
            if not position or not self._append(position, built.after, view):
                return

    def _now(self, view: View) -> Outlook:
        """Return what is known at the beginning of the current step: relative motions start where it began first."""
        now, start = Outlook.of(view), self.at.progress.start
        relative = any(target.by is not None for _, target in self.at.step.targets())
        return replace(now, T_world_tcp=pose_to_matrix(start)) if relative and start is not None else now

    def _append(self, position: Position, before: Outlook, view: View) -> bool:
        """Queue the stages of a step; return whether it could be built."""
        flow, current = self.at.program, position == self.at.position
        step, file = flow.step(position), flow.file(position)
        main, progress = flow.files[flow.main].program, self.at.progress
        cycle = StepCycle(step.id, position=position)
        repeated = Repeated(progress.reached, progress.held) if current and self.at.repeated else None
        try:
            if isinstance(step, Pick):
                if not current:
                    return False
                if not view.holding and not self.has_fresh_image(view):
                    raise NotSeen(self.unseen(view) or "no picture since the last motion of the fingers")
            speed = file.program.speed or main.speed
            built = Builder(self.cell, file.program.poses, speed, before, view, cycle, repeated,
                            flow.patterns(position)).build(step)
        except NotSeen as error:
            if self._spent >= getattr(step, "timeout", 0.0):
                self._fail_step(str(error))
            else:
                self.status.message = f"{step.id} waits: {error}"
            return False
        except ZencellError as error:
            if current:
                self._fail_step(str(error))
            return False
        self._queued.append((cycle, built))
        self.queue += built.stages
        return True


def _undecided(condition: Condition, position: Position) -> bool:
    raise Undecided
