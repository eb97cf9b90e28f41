"""What every message is made of."""

from __future__ import annotations

from copy import deepcopy
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

SCHEMA_VERSION = 1

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
_UNCHANGING = (str, int, float, bool, bytes, type(None))
Name = Annotated[str, Field(min_length=1, max_length=120)]


class Message(BaseModel):
    """Base of everything that is sent."""

    model_config = ConfigDict(extra="forbid")

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        """A copy that shares nothing that can be changed; pydantic makes one of each default that is a message."""
        fields = {
            name: value if type(value) in _UNCHANGING else deepcopy(value, memo)
            for name, value in self.__dict__.items()
        }
        copied = self.__class__.__new__(self.__class__)
        object.__setattr__(copied, "__dict__", fields)
        object.__setattr__(copied, "__pydantic_fields_set__", set(self.__pydantic_fields_set__))
        object.__setattr__(copied, "__pydantic_extra__", None)
        object.__setattr__(copied, "__pydantic_private__", None)  # messages have none
        return copied


class Header(Message):
    """When and in which frame."""

    stamp: int = Field(0, ge=0, description="cell time [ns since the Unix epoch]")
    frame_id: str = ""
