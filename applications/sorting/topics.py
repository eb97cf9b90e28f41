"""Messages and topics of sorting."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field

from common import messages as m
from common.application import ApplicationTopics
from common.messages.basics import Color, Count, Finite, Fraction, Header, Label, Message, Name, Pose, Text, Vector3
from common.messages.execution import TaskStatus
from common.messages.robot import Joints
from common.topics import Topic

MAX_OBJECTS = 100  # in a tray
MAX_GRASPS = 60  # of one image
LARGEST = 10.0  # [m]


def _require_size(size: Vector3) -> Vector3:
    for axis, side in (("x", size.x), ("y", size.y), ("z", size.z)):
        if not 0 <= side <= LARGEST:
            raise ValueError(f"size.{axis} {side:g} is not from 0 to {LARGEST:g} m")
    return size


Size = Annotated[Vector3, AfterValidator(_require_size)]
Position = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Volume = Annotated[float, Field(ge=0, le=LARGEST**3)]
Width = Annotated[float, Field(ge=0, le=0.2)]


class SeenObject(Message):
    """A connected piece of the surface in the tray or a container; objects that touch may be seen as one.

    Lengths in world [m]. `size` is along the principal axes of its view from above (length, width) and its height
    above its support; `yaw` [rad] is the direction of the length. `outline` is its convex hull from above.
    """

    id: Name
    place: Name = Field("tray", description="id of the container that it lies in; 'table' or 'floor' outside of all")
    center: Vector3 = Field(description="center of its surface seen from above")
    size: Size
    yaw: Finite = 0.0
    outline: list[tuple[Position, Position]] = Field([], max_length=64)
    top: Position = Field(0.0, description="z of its highest point")
    bottom: Position = Field(0.0, description="z of its support")
    volume: Volume = Field(0.0, description="below its surface, down to its support [m^3]")
    color: Color = Color()
    color_name: Label = Field("", description="red, orange, yellow, green, blue, purple, white, grey, black")
    shape: Label = Field("", description="round, long, flat, ring, box, other")
    confidence: Fraction = Field(1.0, description="that this is one object")
    why: Text = Field("", description="what is uncertain, for operators")


class GraspCandidate(Message):
    """A grasp by two parallel fingers.

    `pose` is the tool center point while gripping, in world; `approach` the pose from which the tool reaches it on a
    straight line. `width` is the distance of the contacts, `opening` that of the fingers on the way. With `proved` the
    planning kernel found `q_approach`, `q` and the line between them reachable and free of collisions with the robot's
    surroundings and the measured points.
    """

    id: Name
    object: Name = Field(description="id of the SeenObject")
    pose: Pose
    approach: Pose
    width: Width
    opening: Width
    score: Finite = Field(description="larger is better; 0 to 1")
    parts: dict[Label, Finite] = Field({}, max_length=16, description="what the score consists of")
    proved: bool = False
    q_approach: Joints = Field([], description="at `approach` [rad]")
    q: Joints = Field([], description="at `pose` [rad]")
    why: Text = Field("", description="why it is not proved")


class Left(Message):
    """An object without a proved grasp."""

    object: Name
    reason: Text


class Foreign(Message):
    """A box around points that belong to no known object, such as a hand: nothing may move into it."""

    center: Vector3
    size: Size


class Heap(Message):
    """What the cameras see: objects, grasps for those in the tray, and foreign bodies, from one image."""

    max_bytes: ClassVar[int] = 1024 * 1024
    max_parts: ClassVar[int] = 64 * 1024

    header: Header
    at_home: bool = Field(False, description="nothing of the tray was hidden; only then objects and grasps are given. "
                                           "Elsewhere they are those of the newest image from home")
    objects: list[SeenObject] = Field([], max_length=MAX_OBJECTS)
    grasps: list[GraspCandidate] = Field(
        [], max_length=MAX_GRASPS, description="the best first; proved ones before others")
    left: list[Left] = Field([], max_length=MAX_OBJECTS)
    foreign: list[Foreign] = Field([], max_length=MAX_OBJECTS)
    scorer: Label = Field("", description="geometric or learned")
    hidden: Fraction = Field(0.0, description="fraction of the tray without a measurement")
    seconds: Finite = Field(0.0, description="from the image to the proved grasps, wall time")


class SortingStatus(TaskStatus):
    """State and counters of the sorting task. `subject` is the id of the current object."""

    state: Literal["IDLE", "GRASPING", "CHECKING", "PLACING", "STIRRING", "HOMING", "DONE", "ERROR"] = "IDLE"
    attempts: Count = Field(0, description="times that the fingers closed, or hit something on the way down")
    held: Label = Field("", description="what the check after the lift found: one, empty, two, slipped")
    grasp: Label = Field("", description="id of the grasp of the last attempt")
    last: Text = Field("", description="result of the last attempt")


HEAP = Topic("heap", Heap, "stream", "objects in the tray, grasps for them, foreign bodies; from one image")
HEAP_IMAGE = Topic("heap/image", m.Image, "stream", "the image with objects and grasps drawn in; sent while someone "
                                                    "listens")
SORTING_STATUS = Topic("sorting_status", SortingStatus, "state", "state and counters of the sorting task")

TOPICS = ApplicationTopics(
    status=SORTING_STATUS, decided_by=HEAP, annotated=HEAP_IMAGE, declared=(HEAP, HEAP_IMAGE, SORTING_STATUS))
