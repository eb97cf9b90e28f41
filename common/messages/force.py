"""Messages about forces at the tool."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from common.messages.basics import SMALL_BYTES, Finite, Header, Message, OperatorName, Text, Vector3


class Wrench(Message):
    """What the environment exerts on the tool and a held object, at the tool centre point, along the tool's axes.

    `frame_id` of the header is the link of the tool centre point. The weight of tool and held object is subtracted.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    force: Vector3 | None = Field(None, description="[N]; null: unknown, see reason")
    torque: Vector3 | None = Field(None, description="about the tool centre point [N m]; null: unknown, see reason")
    zeroed: bool = Field(False, description="whether the sensor was zeroed since the executor started")
    payload: Finite = Field(0.0, description="mass whose weight is subtracted, by the arm's controller or here [kg]")
    com: Vector3 = Field(Vector3(), description="centre of mass of that payload, from the flange [m]")
    reason: Text = Field("", description="why there is no wrench; empty while there is one")


class ZeroWrench(Message):
    """Take the present wrench as zero: nothing must touch the tool. Refused unless the arm is at rest.

    The stamp of the header is the time of the decision: a late request is refused.
    """

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    owner: OperatorName = Field("", description="operator who requests it; empty for a task")
