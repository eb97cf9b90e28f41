"""Contours in the picture, the outline in the world, and the task that traces it."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, computed_field, model_validator

from common.messages.basics import Finite, Header, Message, Name
from common.messages.geometry import Color, PoseArray
from common.messages.task import TaskStatus


class Contour(Message):
    """One closed contour in a picture. `pixels` are (u, v) [px], every one along the edge."""

    index: int = Field(ge=0)
    label: Name
    pixels: list[tuple[Finite, Finite]] = Field(min_length=1)
    area: Finite = Field(0.0, description="[px^2]")
    parent: int = Field(-1, description="index of the contour around this one, or -1")
    touches_border: bool = False
    color: Color = Color()


class Contours(Message):
    """All contours of one picture, and the one that was chosen."""

    header: Header
    width: int = Field(ge=1)
    height: int = Field(ge=1)
    contours: list[Contour] = []
    selected: int = Field(-1, description="index of the chosen contour, or -1")
    message: str = ""


class OutlineSelect(Message):
    """Choose an object: the largest that does not touch the border, one of a colour, or one by its index."""

    rule: Literal["auto", "colour", "index"] = "auto"
    index: int | None = Field(None, ge=0)
    colour: str = Field("", description="red, green, blue, yellow, ... of the object's inside")


class OutlineSelection(Message):
    """What was chosen."""

    index: int
    label: str


class OutlinePoints(PoseArray):
    """The outline of the top face of the chosen object, closed: the last point is followed by the first.

    The stamp is that of the picture. Without a chosen object, or when its outline cannot be told, there are no poses
    and `message` says why.
    """

    object: str = Field("", description="label of the chosen contour")
    invalid_depth: int = Field(0, ge=0, description="pixels whose depth was filled from neighbours")
    given: bool = Field(False, description="by a file: need not be the outline of anything that was seen")
    message: str = ""


OutlineState = Literal[
    "IDLE", "SELECTING", "PLANNING", "APPROACHING", "TRACING", "RETREATING", "HOMING", "DONE", "ERROR"
]


class OutlineStatus(TaskStatus):
    """State and figures of the outline task. `subject` is the label of the object that is outlined."""

    state: OutlineState = "IDLE"
    points: int = 0
    fraction: Finite = 0.0
    length_m: Finite = 0.0
    closed: bool = False
    invalid_depth: int = Field(0, description="pixels of the contour whose depth was filled from neighbours")
    standoff: Finite = Field(0.0, description="of the tool above the contour [m]")

    @model_validator(mode="before")
    @classmethod
    def _from_seed_name(cls, values: Any) -> Any:
        if not isinstance(values, dict) or "object" not in values:
            return values
        return {"subject": values["object"]} | {name: value for name, value in values.items() if name != "object"}

    @computed_field  # type: ignore[prop-decorator]
    @property
    def object(self) -> str:
        """Label of the object that is outlined."""
        return self.subject
