"""Topic of the insertion."""

from __future__ import annotations

from typing import Literal

from common.application import ApplicationTopics
from common.messages.execution import TaskStatus
from common.topics import Topic


class InsertionStatus(TaskStatus):
    """State and counters; `done` counts the pegs that the camera sees in the hole, `subject` is the current one."""

    state: Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"] = "IDLE"


INSERTION_STATUS = Topic("insertion_status", InsertionStatus, "state", "state and counters of the insertion")

TOPICS = ApplicationTopics(status=INSERTION_STATUS, declared=(INSERTION_STATUS,))
