"""Messages and topics of the policy application."""

from __future__ import annotations

from common.application import ApplicationTopics
from common.messages.execution import TaskStatus
from common.topics import Topic


class PolicyStatus(TaskStatus):
    """Progress of a policy: chunks received, proved and refused."""


POLICY_STATUS = Topic("policy_status", PolicyStatus, "state", "state of the policy, its chunks and refusals")
TOPICS = ApplicationTopics(status=POLICY_STATUS, declared=[POLICY_STATUS])
