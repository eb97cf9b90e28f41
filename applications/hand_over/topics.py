"""Topic of the handover."""

from __future__ import annotations

from common.application import ApplicationTopics
from common.tasks.handling import HandlingStatus
from common.topics import Topic


class HandoverStatus(HandlingStatus):
    """State and counters of one arm; `done` counts what its camera shows in its container."""


HANDOVER_STATUS = Topic("handover_status", HandoverStatus, "state", "state and counters of a handover")

TOPICS = ApplicationTopics(status=HANDOVER_STATUS, declared=(HANDOVER_STATUS,))
