"""Where a program is: its current step, whether that has started, why it halts, and what is persisted of it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from applications.programming.files import ProgramFile, load_all
from applications.programming.flow import Decide, Flow, Position
from applications.programming.model import BaseStep
from applications.programming.topics import ProgramStatus
from common import messages as m
from common.errors import ConfigError

SUCCEEDED, FAILED = "succeeded", "failed"


class Progress(BaseModel):
    """Where a program is, as persisted before each step."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    program: str = ""  # path of its file; empty: nothing is in progress
    position: Position = ()
    outcome: str = ""  # of the step before
    done: int = 0  # steps
    start: m.Pose | None = None  # of the tool when the step began, in world: relative motions start there
    held: bool = False  # whether the gripper held something then
    reached: str = ""  # last stage of the step that ended


class Cursor:
    """Goes through a program, and shows its place in the status."""

    def __init__(self, status: ProgramStatus) -> None:
        """Start without a program."""
        self.status = status
        self.flow: Flow | None = None
        self.ids: set[str] = set()  # of all steps
        self.position: Position = ()
        self.in_step = False  # whether the step there has started
        self.repeated = False  # whether it was interrupted before
        self.single = False  # whether to halt before each step
        self.passes = False  # whether the next step begins in any case: the operator let the program continue there
        self.progress = Progress()
        self.persisted: Progress | None = None  # newest progress on disk
        self.saves = False  # whether progress is saved at all

    @property
    def program(self) -> Flow:
        """The loaded program. Raises ConfigError."""
        if self.flow is None:
            raise ConfigError("program", ..., "none is loaded: name one")
        return self.flow

    @property
    def step(self) -> BaseStep:
        """The current step."""
        return self.program.step(self.position)

    @property
    def file(self) -> ProgramFile:
        """The file of the current step."""
        return self.program.file(self.position)

    @property
    def is_saved(self) -> bool:
        """Whether the position of the current step is on disk, so that it may begin."""
        saved, now = self.persisted, self.progress
        return not self.saves or (saved is not None and (saved.position, saved.done) == (now.position, now.done))

    def load(self, file: ProgramFile) -> None:
        """Go to the first step of a program. Raises BadProgram."""
        self.flow = Flow(load_all(file), file.name)
        self.ids = {step for each in self.flow.files.values() for step in each.steps}
        status = self.status
        status.program, status.breakpoints = file.name, [each for each in status.breakpoints if each in self.ids]
        self.restart()

    def restart(self, id_: str = "") -> None:
        """Go to a step of the main program; by default to the first one. Raises UnknownName."""
        position = self.program.find(id_) if id_ else self.program.start
        self.status.done, self.status.total, self.status.outcome, self.status.halted = 0, 0, "", ""
        self.progress = Progress()
        self.go_to(position)

    def resume_from(self, progress: Progress) -> bool:
        """Go to where a program was interrupted; return whether its file still has that step."""
        if not self.program.contains(progress.position):
            return False
        self.progress, self.status.done, self.status.outcome = progress, progress.done, progress.outcome
        self.go_to(progress.position)
        self.repeated = True
        return True

    def go_to(self, position: Position) -> None:
        """Make a position the current one."""
        self.position, self.in_step, self.repeated = position, False, False
        self.show()

    def advance(self, decide: Decide) -> bool:
        """Follow loops and conditions to the next step that does something, and begin it unless the program halts.

        Returns:
            Whether a step has started.

        Raises:
            Undecided: a condition is not known.
        """
        if self.in_step or not self.position:
            return self.in_step
        self.position = self.program.leaf(self.position, decide)
        self.show()
        if not self.position:
            return False
        if not self.passes and self.single:
            self.status.halted = f"single step: {self.step.id} is next"
        elif not self.passes and self.step.id in self.status.breakpoints:
            self.status.halted = f"breakpoint at {self.step.id}"
        return not self.status.halted

    def begin(self, tool: m.Pose | None, *, holding: bool) -> None:
        """Note the beginning of the current step, with the pose of the tool in world; a repeated one began before."""
        self.in_step, self.passes = True, False
        if self.repeated and self.progress.position == self.position and self.progress.start is not None:
            self.progress = self.progress.model_copy()  # is saved again
            return
        main = self.program.files[self.program.main]
        self.progress = Progress(
            program=str(main.path), position=self.position, outcome=self.status.outcome, done=self.status.done,
            start=tool, held=holding)

    def reach(self, stage: str) -> None:
        """Note that a stage of the step has ended."""
        self.progress = self.progress.model_copy(update={"reached": stage})

    def finish(self, outcome: str) -> None:
        """Go to the position after the current step."""
        self.status.outcome, self.status.done = outcome[:500], self.status.done + 1
        self.go_to(self.program.after(self.position))

    def end(self) -> None:
        """Note that the program has ended, so that a restart does not resume it."""
        self.progress = Progress()
        self.status.total = self.status.done

    def show(self) -> None:
        """Show the position in the status."""
        status = self.status
        if not self.position:
            status.step, status.kind, status.line, status.within, status.repetitions = "", "", 0, "", []
            return
        if status.step and not self.program.is_leaf(self.position):
            return  # the control flow is followed at once
        status.step, status.kind, status.within = self.step.id, self.step.step, self.file.name
        status.line, status.repetitions = self.file.lines.get(self.step.id, 0), self.program.repetitions(self.position)
