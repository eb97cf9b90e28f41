"""Messages and topics of belt picking."""

from __future__ import annotations

from typing import Literal

from common import messages as m
from common.application import ApplicationTopics
from common.topics import Topic


class BeltPickingStatus(m.TaskStatus):
    """Status of the task; `done` counts the objects that were put into the container."""

    state: Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"] = "IDLE"


BELT_PICKING_STATUS = Topic("belt_picking_status", BeltPickingStatus, "state",
                            "IDLE, GRASPING, PLACING, HOMING, DONE or ERROR, and counters")
TOPICS = ApplicationTopics(declared=(BELT_PICKING_STATUS,), status=BELT_PICKING_STATUS)
