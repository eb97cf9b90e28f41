"""Messages, topics and the request of the policy application."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from common.application import ApplicationTopics
from common.messages.basics import SMALL_BYTES, Count, Finite, Header, Label, Message, OperatorName, Text
from common.messages.execution import TaskStatus
from common.topics import Request, Topic

Control = Literal["policy", "operator"]


class PolicyStatus(TaskStatus):
    """Progress of a policy: chunks received, proved and refused. `stage` is the id of the newest motion."""

    state: Literal["IDLE", "ACTING", "ENDING", "DONE", "ERROR"] = "IDLE"
    control: Control = Field("policy", description="owner of the arm; an operator takes over with policy/control")
    operator: Label = Field("", description="name of the operator in control")
    chunks: Count = Field(0, description="answers of the policy")
    proved: Count = Field(0, description="chunks that are followed completely, those slowed down included")
    slowed: Count = Field(0, description="chunks that are followed more slowly, to keep the limits of the joints")
    shortened: Count = Field(0, description="chunks of which the first rows are followed")
    refused: Count = Field(0, description="chunks of which nothing is followed")
    late: Count = Field(0, description="chunks that arrived after all of their rows, or joined too late")
    failed: Count = Field(0, description="requests to the policy without a chunk, and answers of a wrong shape")
    violation: Text = Field("", description="why the newest chunk that is not followed completely is not: joint or "
                                            "pair, and time")
    cause: Label = Field("", description="kind of that violation")
    inference_ms: Finite = Field(0.0, description="from observation to chunk, the newest [ms, wall time]")
    proof_ms: Finite = Field(0.0, description="from chunk to proved motion, the newest [ms, wall time]")


class ControlRequest(Message):
    """Take the arm from the policy, which comes to rest and waits, or give it back, where it is then."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    take: bool
    owner: OperatorName = Field("", description="name of the operator")


class ControlReply(Message):
    """The present owner of the arm."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    control: Control
    operator: Label = ""


POLICY_STATUS = Topic("policy_status", PolicyStatus, "state", "state of the policy, its chunks and refusals")
POLICY_CONTROL = Request("policy/control", ControlRequest, ControlReply, "take the arm from the policy, or return it")
TOPICS = ApplicationTopics(status=POLICY_STATUS, declared=[POLICY_STATUS, POLICY_CONTROL])
