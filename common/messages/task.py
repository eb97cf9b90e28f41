"""Telling the task what to do, and what every task says of itself."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from common.messages.basics import Finite, Header, Message
from common.messages.camera import Rejection
from common.messages.execution import Who


class TaskCommand(Message):
    """What a person may tell the task. Who gives no name has none of their own holds."""

    command: Literal["start", "pause", "resume", "stop"]
    by: Who = Field("", description="name of the person")
    override: bool = Field(False, description="start or resume although another person holds the robot; is logged")


class PlanFigure(Message):
    """One successful plan, for the summary."""

    planner: str
    seconds: Finite
    fraction: Finite
    attempts: int


class TaskStatus(Message):
    """How far a task is: what every task says, and the answer to a command. Each task derives a status of its own.

    `figures` are the task's own, by name; they stand in the summary of a run as they are.
    """

    header: Header = Header()
    state: str = Field("IDLE", description="DONE and ERROR end a run; IDLE is at rest; all else is the task's own")
    paused: bool = False
    started: bool = False
    stage: str = ""
    subject: str = Field("", description="what is in work: the id of an object, for example")
    done: int = Field(0, description="of `total`")
    total: int = Field(0, description="what the task has seen and may do or has done")
    failures: int = 0
    retries: int = 0
    skipped: list[Rejection] = Field([], description="what could not be done, where, and why")
    plans: list[PlanFigure] = []
    moving_seconds: Finite = Field(0.0, description="cell time in motion [s]")
    planning_seconds: Finite = Field(0.0, description="wall time spent in plan requests [s]")
    task_seconds: Finite = Field(0.0, description="cell time since the start of the task [s]")
    figures: dict[str, bool | int | Finite | str | None] = {}
    message: str = ""
