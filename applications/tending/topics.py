"""Topic of machine tending."""

from __future__ import annotations

from typing import Literal

from common.application import ApplicationTopics
from common.messages.execution import TaskStatus
from common.topics import Topic


class TendingStatus(TaskStatus):
    """State and counters; `done` counts the parts seen on the pallet, `subject` is the id of the current one."""

    state: Literal["IDLE", "GRASPING", "PLACING", "HOMING", "MACHINING", "DONE", "ERROR"] = "IDLE"


TENDING_STATUS = Topic("tending_status", TendingStatus, "state", "state and counters of machine tending")

TOPICS = ApplicationTopics(status=TENDING_STATUS, declared=(TENDING_STATUS,))
