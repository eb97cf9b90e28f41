"""Telling the task what to do, and what it says of itself."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from common.messages.basics import Finite, Header, Message
from common.messages.camera import Rejection

TaskState = Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"]


class TaskCommand(Message):
    """What a person may tell the task."""

    command: Literal["start", "pause", "resume", "stop"]


class TaskStatus(Message):
    """How far a task is, as the answer to a command: every task has more to say in a status of its own."""

    header: Header = Header()
    state: str = "IDLE"
    paused: bool = False
    started: bool = False
    stage: str = ""
    message: str = ""


class PlanFigure(Message):
    """One successful plan, for the summary."""

    planner: str
    seconds: Finite
    fraction: Finite
    attempts: int


class PickPlaceStatus(Message):
    """State and counters of the pick-and-place task."""

    header: Header = Header()
    state: TaskState = "IDLE"
    paused: bool = False
    started: bool = False
    stage: str = ""
    target: str = Field("", description="track id of the object in work")
    placed: int = 0
    targets: int = Field(0, description="objects that the task has seen and may take or has taken")
    failures: int = 0
    retries: int = 0
    skipped: list[Rejection] = Field([], description="validated targets that could not be taken, and why")
    plans: list[PlanFigure] = []
    moving_seconds: Finite = Field(0.0, description="cell time in motion [s]")
    planning_seconds: Finite = Field(0.0, description="wall time spent in plan requests [s]")
    task_seconds: Finite = Field(0.0, description="cell time since the start of the task [s]")
    message: str = ""
