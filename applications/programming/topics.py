"""Messages, topics and requests of programs."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.application import ApplicationTopics
from common.messages.basics import SMALL_BYTES, Count, Header, Label, Message, Name, OperatorName, Remark, Seconds, Text
from common.messages.execution import Acknowledged, TaskStatus
from common.topics import Request, Topic

ProgramText = Annotated[str, Field(max_length=200_000)]


class RehearsedStep(Message):
    """What a dry run found of one step, in the order of its execution."""

    program: Label
    step: Label = Field(description="id")
    kind: Label = Field(description="move, grip, ...")
    seconds: Seconds | None = Field(None, description="planned duration, cell time; None: not known")
    unknown: Remark = Field("", description="what the duration depends on, if it is not known, or not exact; "
                                       "with a problem, what the problem depends on")
    problem: Remark = Field("", description="why it cannot run: no path, unknown pose, missing signal")


class Rehearsal(Message):
    """Result of a dry run so far: nothing moves, each motion is planned and shown as display_trajectory."""

    program: Label = ""
    state: Literal["none", "running", "done", "failed"] = "none"
    step: Label = Field("", description="id of the step that is planned or shown now")
    seconds: Seconds = Field(0.0, description="sum of the known durations [s, cell time]")
    steps: list[RehearsedStep] = Field([], max_length=1000)
    message: Remark = ""


class ProgramStatus(TaskStatus):
    """State of the program. `stage` is the motion or signal of the step."""

    max_bytes: ClassVar[int] = 512 * 1024

    state: Literal["IDLE", "RUNNING", "DONE", "ERROR"] = "IDLE"
    program: Label = Field("", description="name of the program that is loaded; empty: none")
    within: Label = Field("", description="name of the program that the step is of, which another one may call")
    step: Label = Field("", description="id of the step that runs, or that is next")
    kind: Label = Field("", description="of that step: move, grip, ...")
    line: Count = Field(0, description="of that step in its file; 0: unknown")
    repetitions: list[Label] = Field([], max_length=50, description="of the loops around it, such as `loop1: 2 of 3`")
    halted: Remark = Field("", description="why the operator has to let it continue: a breakpoint, a single step, a "
                                           "restart in the middle; empty while it runs")
    outcome: Remark = Field("", description="of the step before: succeeded, failed, or what a function returned")
    breakpoints: list[Label] = Field([], max_length=200, description="ids of steps that it halts before")
    rehearsal: Rehearsal = Rehearsal()


class ProgramCommand(Message):
    """Command the program. All but pause, stop, breakpoint and dry_run make the robot move."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    command: Literal["run", "run_from", "step", "resume", "pause", "stop", "breakpoint", "dry_run"]
    program: Label = Field("", description="name of the program to load first; empty: the one that is loaded")
    step: Label = Field("", description="id of a step of the program: of run_from, of breakpoint, and where a dry_run "
                                        "or a single step starts")
    enabled: bool = Field(True, description="of breakpoint: set it, or remove it")
    paced: bool = Field(False, description="of dry_run: show each motion for as long as it takes")
    by: OperatorName = Field("", description="name of the operator")
    override: bool = Field(False, description="although another operator holds the robot; is logged")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones stay")


class ProgramEdit(Message):
    """List the programs of the folder, or read, check, save or delete one."""

    max_bytes: ClassVar[int] = 512 * 1024

    act: Literal["list", "load", "check", "save", "delete"]
    program: Label = Field("", description="name, which is that of its file without .yaml")
    text: ProgramText = Field("", description="of check and save: YAML")
    by: OperatorName = Field("", description="name of the operator")
    revision: Label = Field("", description="of save and delete: of the file when it was read; empty: no file yet")


class ProgramContent(Message):
    """Answer to an edit. A program with problems is not saved."""

    max_bytes: ClassVar[int] = 512 * 1024

    header: Header = Header()
    programs: list[Name] = Field([], max_length=1000, description="names of all programs of the folder")
    program: Label = ""
    text: ProgramText = Field("", description="YAML, with an id for each step")
    revision: Label = Field("", description="of the file after the edit; empty: there is no file, or it was not saved")
    problems: list[Text] = Field([], max_length=200, description="file, line, step, field, value and choices")
    poses: list[Label] = Field([], max_length=500, description="names that a target may have")
    signals: list[Label] = Field([], max_length=500, description="signals of the cell")


PROGRAM_STATUS = Topic(
    "program/status", ProgramStatus, "state", "state of the program: step, halts, breakpoints, dry run")
PROGRAM_COMMAND = Request("program/command", ProgramCommand, ProgramStatus, "run, halt or rehearse the program")
PROGRAM_EDIT = Request("program/edit", ProgramEdit, ProgramContent, "read, check and save programs")
TOPICS = ApplicationTopics(status=PROGRAM_STATUS, declared=[PROGRAM_STATUS, PROGRAM_COMMAND, PROGRAM_EDIT],
                           of_arm=[PROGRAM_COMMAND, PROGRAM_EDIT])
