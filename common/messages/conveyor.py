"""Messages about conveyor belts."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from common.messages.basics import (
    SMALL_BYTES,
    UNKNOWN_OPERATOR,
    Finite,
    Header,
    Label,
    Message,
    Name,
    OperatorName,
)
from common.messages.execution import Acknowledged

MAX_BELTS = 8


class BeltState(Message):
    """One belt: what its encoder and its light barrier report. A speed is along the belt, negative backwards."""

    name: Name
    position: Finite = Field(0.0, description="way of the surface since the start, by the encoder [m]")
    speed: Finite = Field(0.0, description="[m/s]")
    running: bool = Field(False, description="whether it is switched on: it may still start, brake, or wait")
    set_speed: Finite = Field(0.0, description="speed while it runs [m/s]")
    blocked: bool = Field(False, description="whether something is in its light barrier")


class ConveyorState(Message):
    """All belts of a cell, at the time of the header."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    belts: list[BeltState] = Field([], max_length=MAX_BELTS)

    def find(self, name: str) -> BeltState | None:
        """Return a belt by name."""
        return next((belt for belt in self.belts if belt.name == name), None)


class ConveyorSet(Message):
    """Start or stop a belt, or change its speed. The stamp of the header is the time of the decision."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    name: Label = Field("", description="of the belt; empty: the only one")
    running: bool | None = Field(None, description="null: as it is")
    speed: Annotated[float, Field(ge=-2, le=2, allow_inf_nan=False)] | None = Field(
        None, description="while it runs [m/s]; null: as it is")
    owner: OperatorName = Field(
        UNKNOWN_OPERATOR, min_length=1, description="operator, or service of a task, that requests it")
    acknowledged: Acknowledged = Field(
        None, description="`since` of the newest interlock that the operator has seen: later ones block a start")
