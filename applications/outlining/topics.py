"""Messages and topics of outlining."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field, computed_field, model_validator

from common import messages as m
from common.application import ApplicationTopics
from common.messages.basics import (
    SMALL_BYTES,
    Color,
    Count,
    Finite,
    Header,
    Label,
    Message,
    Name,
    Pose,
    PoseArray,
    Text,
)
from common.messages.execution import TaskStatus
from common.topics import Request, Topic

MAX_POINTS = 20_000  # of an outline


class Contour(Message):
    """One closed contour in an image. `pixels` are (u, v) [px], every one along the edge."""

    index: Count
    label: Name
    pixels: list[tuple[Finite, Finite]] = Field(min_length=1, max_length=65_536)
    area: Finite = Field(0.0, description="[px^2]")
    parent: int = Field(-1, description="index of the contour around this one, or -1")
    touches_border: bool = False
    color: Color = Color()


class Contours(Message):
    """All contours of one image, and the selected one."""

    max_bytes: ClassVar[int] = 4 * 1024 * 1024
    max_parts: ClassVar[int] = 128 * 1024

    header: Header
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)
    contours: list[Contour] = Field([], max_length=1000)
    selected: int = Field(-1, description="index of the chosen contour, or -1")
    message: Text = ""

    @model_validator(mode="after")
    def _is_a_tree(self) -> Contours:
        places = range(len(self.contours))
        if [contour.index for contour in self.contours] != [*places]:
            raise ValueError("the indices of contours must be 0, 1, ... in their order")
        if self.selected != -1 and self.selected not in places:
            raise ValueError(f"contour {self.selected} is selected, of {len(places)}")
        within = {-1}  # contours known to be in no cycle
        for contour in self.contours:
            way, at = set[int](), contour.index
            while at not in within:
                way.add(at)
                at = self.contours[at].parent
                if at in way or (at != -1 and at not in places):
                    raise ValueError(f"contour {contour.index} lies within {contour.parent}, which cannot be")
            within |= way
        return self


class OutlineSelect(Message):
    """Choose an object: the largest that does not touch the border, one of a colour, or one by its index."""

    max_bytes: ClassVar[int] = SMALL_BYTES
    omitted_defaults: ClassVar[tuple[str, ...]] = ("at",)

    rule: Literal["auto", "colour", "index"] = "auto"
    index: Count | None = None
    at: tuple[Finite, Finite] | None = Field(
        None, description="where the middle of its contour was seen to have that index [px]: another picture may count "
                          "otherwise, and then what is there counts"
    )
    colour: Label = Field("", description="red, green, blue, yellow, ... of the object's inside")


class OutlineSelection(Message):
    """The selected contour."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    index: int
    label: Label


class OutlinePoints(PoseArray):
    """Outline of the selected object's top face, closed: the last point is followed by the first.

    The stamp is that of the image. Without a selected object, or without a known outline, there are no poses, and
    `message` has the reason.
    """

    max_bytes: ClassVar[int] = 4 * 1024 * 1024
    max_parts: ClassVar[int] = 128 * 1024

    poses: list[Pose] = Field([], max_length=MAX_POINTS)
    ids: list[Label] = Field([], max_length=MAX_POINTS)
    labels: list[Label] = Field([], max_length=MAX_POINTS)
    object: Label = Field("", description="label of the chosen contour")
    invalid_depth: Count = Field(0, description="pixels whose depth was filled from neighbours")
    given: bool = Field(False, description="by a file: need not be the outline of anything that was seen")
    message: Text = ""


OutlineState = Literal[
    "IDLE", "SELECTING", "PLANNING", "APPROACHING", "TRACING", "RETREATING", "HOMING", "DONE", "ERROR"
]


class OutlineStatus(TaskStatus):
    """State and figures of the outlining task. `subject` is the label of the outlined object."""

    state: OutlineState = "IDLE"
    points: Count = 0
    fraction: Finite = 0.0
    length_m: Finite = 0.0
    closed: bool = False
    invalid_depth: Count = Field(0, description="pixels of the contour whose depth was filled from neighbours")
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
        """Label of the outlined object."""
        return self.subject


CONTOURS = Topic("contours", Contours, "state", "contours of the picture and the chosen one")
CONTOUR_IMAGE = Topic("contour_image", m.Image, "state", "the picture with labelled contours")
CONTOUR_POINTS = Topic("contour_points", OutlinePoints, "state", "outline of the chosen object's top face in world")
CONTOUR_PATH = Topic("contour_path", OutlinePoints, "state", "the same, cleared of duplicates")
OUTLINE_STATUS = Topic("outline_status", OutlineStatus, "state", "state and figures")
OUTLINE_SELECT = Request("outline/select", OutlineSelect, OutlineSelection, "choose the object to outline")

TOPICS = ApplicationTopics(
    declared=(CONTOURS, CONTOUR_IMAGE, CONTOUR_POINTS, CONTOUR_PATH, OUTLINE_STATUS, OUTLINE_SELECT),
    status=OUTLINE_STATUS, decided_by=CONTOUR_PATH, annotated=CONTOUR_IMAGE,
)
