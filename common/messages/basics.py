"""What every message is made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

SCHEMA_VERSION = 1

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=120)]


class Message(BaseModel):
    """Base of everything that is sent."""

    model_config = ConfigDict(extra="forbid")


class Header(Message):
    """When and in which frame."""

    stamp: int = Field(0, ge=0, description="cell time [ns since the Unix epoch]")
    frame_id: str = ""
