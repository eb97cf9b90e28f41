"""Messages of a cell with several arms: permission to move next to the other arms."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from common.messages.basics import SMALL_BYTES, Header, Label, Message, Name, Seconds, Text
from common.messages.execution import ExecuteRequest
from common.messages.robot import TRAJECTORY_BYTES, JointTrajectory
from common.messages.scene import AttachedObject

ReservationState = Literal["granted", "wait", "refused"]


class ReserveRequest(Message):
    """Ask whether an arm may follow a trajectory next to the other arms; the executor asks before each motion.

    A repeated id is the same request and keeps its place in the queue; it counts as withdrawn when it is not repeated
    for 2 s. Without a trajectory the arm asks to move alone, on no known path, until it stops repeating the request.
    """

    max_bytes: ClassVar[int] = TRAJECTORY_BYTES + 2 * SMALL_BYTES
    max_parts: ClassVar[int] = ExecuteRequest.max_parts

    header: Header = Header()
    arm: Name
    id: Name = Field(description="goal of the arm")
    trajectory: JointTrajectory | None = Field(None, description="null: the arm asks to move alone")
    attached: list[AttachedObject] = Field(
        [], max_length=50, description="carried besides what the planning scene of the arm says")
    may_touch: list[Label] = Field(
        [], max_length=50, description="that of the motion request: object that another arm carries, and that the "
                                    "gripper may touch for a handover")
    joins: Label = Field("", description="id of the goal that this one continues at speed, from `join_time` of it [s]")
    join_time: float = Field(0.0, ge=-1e9, le=1e9)


class ReserveReply(Message):
    """The coordinator's answer; a granted motion starts when the coordinator releases its hold."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    state: ReservationState
    error: Label = Field("", description="code of a refusal: blocked, unknown_arm, blocked_too_long, not_proved, "
                                          "may_touch")
    message: Text = Field("", description="what the motion waits for, or why it is refused")
    waits_for: list[Label] = Field([], max_length=16, description="arms that it waits for")
    waited: Seconds = Field(0.0, description="time since the first request of this id [s, cell time]")


class ArmsStatus(Message):
    """What the coordinator of several arms does: tickets, and whether its arms keep their schedules."""

    max_bytes: ClassVar[int] = 64 * 1024

    header: Header = Header()
    waiting: list[Text] = Field([], max_length=64, description="requests in the order of their tickets, with reasons")
    moving: list[Label] = Field([], max_length=16, description="arms with a committed motion")
    held: list[Label] = Field([], max_length=16, description="arms that the coordinator holds on their path")
    band: Seconds = Field(0.0, description="difference of schedules that is proved now, the largest of all pairs [s]")
    message: Text = ""
