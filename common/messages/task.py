"""Telling the task what to do, and what every task says of itself."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from common.messages.basics import SMALL_BYTES, Count, Finite, Header, Label, Message, Name, OperatorName, Text
from common.messages.camera import Rejection
from common.messages.execution import Acknowledged


class TaskCommand(Message):
    """What a person may tell the task. Who gives no name has none of their own holds."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    command: Literal["start", "pause", "resume", "stop"]
    by: OperatorName = Field("", description="name of the person")
    override: bool = Field(False, description="start or resume although another person holds the robot; is logged")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones stay")


class PlanFigure(Message):
    """One successful plan, for the summary."""

    planner: Label
    seconds: Finite
    fraction: Finite
    attempts: Count


class TaskStatus(Message):
    """How far a task is: what every task says, and the answer to a command. Each task derives a status of its own.

    `figures` are the task's own, by name; they stand in the summary of a run as they are.
    """

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024

    header: Header = Header()
    state: Label = Field("IDLE", description="DONE and ERROR end a run; IDLE is at rest; all else is the task's own")
    paused: bool = False
    started: bool = False
    stage: Label = ""
    subject: Label = Field("", description="what is in work: the id of an object, for example")
    done: Count = Field(0, description="of `total`")
    total: Count = Field(0, description="what the task has seen and may do or has done")
    failures: Count = 0
    retries: Count = 0
    skipped: list[Rejection] = Field([], max_length=1000, description="what could not be done, where, and why")
    plans: list[PlanFigure] = Field([], max_length=1000)
    moving_seconds: Finite = Field(0.0, description="cell time in motion [s]")
    planning_seconds: Finite = Field(0.0, description="wall time spent in plan requests [s]")
    task_seconds: Finite = Field(0.0, description="cell time since the start of the task [s]")
    figures: dict[Name, bool | int | Finite | Text | None] = Field({}, max_length=200)
    message: Text = ""
    overlooked: Text = Field("", description="what was seen and not done, in words, as the task ends")
