"""What every part of the configuration is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Rgb = tuple[
    Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)]
]


@dataclass(frozen=True)
class AtRunTime:
    """Marks a field whose value may change while its service runs."""


T = TypeVar("T")
Tunable = Annotated[T, AtRunTime()]  # as in `min_area: Tunable[float] = Field(...)`: read it where it is used


class Section(BaseModel):
    """A part of the cell that several services may need."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)  # see common/messages/basics.py


class Parameters(BaseModel):
    """Base of the `Config` of a service, and of the `Options` of a planner or hardware backend.

    Fields that are `Tunable` are changed in place, between two turns of the service's event loop, when somebody sets
    them; so is a section that has such fields. Nothing else ever changes.
    """

    model_config = ConfigDict(extra="forbid", defer_build=True)
