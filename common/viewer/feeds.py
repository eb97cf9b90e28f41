"""What the page reads, and when: everything that the cell has, pictures and the truth only while somebody looks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from common import topics
from common.application import applications
from common.applications.outlining.topics import CONTOUR_IMAGE, CONTOUR_PATH, CONTOURS, OUTLINE_STATUS
from common.applications.pick_place.topics import (
    DETECTED_OBJECTS,
    DETECTION_IMAGE,
    PICK_PLACE_STATUS,
    REJECTED_TARGETS,
    VALIDATED_TARGETS,
    WORKSPACE_MARKERS,
)
from common.config import Members
from common.messages import Message
from common.topics import Request, Topic, platform_topics

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.reader import Reader

M = TypeVar("M", bound=Message)

ALWAYS: tuple[Topic[Any], ...] = (  # small or seldom
    topics.JOINT_STATES, topics.TF_STATIC, topics.PLANNING_SCENE, VALIDATED_TARGETS, REJECTED_TARGETS,
    WORKSPACE_MARKERS, topics.CAMERA_INFO, topics.DEPTH_CAMERA_INFO, topics.DISPLAY_TRAJECTORY,
    topics.MOTION_STATUS, topics.GRIPPER_STATE, PICK_PLACE_STATUS, OUTLINE_STATUS,
    CONTOUR_PATH, topics.SUPERVISOR_STATUS, topics.COUNTERS, topics.LOG,
)
ON_DEMAND: tuple[Topic[Any], ...] = (  # large, or made only for who listens
    topics.CAMERA_IMAGE, DETECTION_IMAGE, topics.DEPTH_CAMERA_IMAGE, CONTOUR_IMAGE, CONTOURS,
    topics.SCENE_OBJECTS, topics.TF, DETECTED_OBJECTS,
)
_LOG_SIZE = 2000  # lines that may wait


def in_cell(topic: Topic[Any] | Request[Any, Any], members: Members) -> bool:
    """Whether a cell may have a topic: one of the platform's or its application's; any, with one of a person's own."""
    own = next((found for found in applications() if found.name == members.application), None)
    return own is None or topic.key in platform_topics() or topic.key in own.topics


class Feeds:
    """A reader for each topic that the cell has."""

    def __init__(self, bus: Bus, members: Members) -> None:
        """Declare the readers.

        Args:
            bus: of the service.
            members: who is in the cell.
        """
        self._bus = bus
        self._readers: dict[str, Reader[Any]] = {}
        self._seen: dict[str, Message] = {}
        for topic in (*ALWAYS, *ON_DEMAND):
            if in_cell(topic, members):
                self._readers[topic.key] = bus.reader(topic, size=_LOG_SIZE, listening=topic in ALWAYS)

    def __contains__(self, topic: Topic[Any]) -> bool:
        return topic.key in self._readers

    def reader(self, topic: Topic[M]) -> Reader[M] | None:
        """The reader of a topic, or None when the cell does not have it."""
        return self._readers.get(topic.key)

    def latest(self, topic: Topic[M]) -> M | None:
        """The newest message of a topic, or None."""
        reader = self._readers.get(topic.key)
        return reader.latest if reader is not None else None

    def fresh(self, topic: Topic[M]) -> M | None:
        """The newest message of a topic, when it was not returned yet."""
        message = self.latest(topic)
        if message is None or message is self._seen.get(topic.key):
            return None
        self._seen[topic.key] = message
        return message

    def listen(self, wanted: Iterable[Topic[Any]]) -> None:
        """Listen to these of the topics that are read on demand, and to no other of them."""
        keys = {topic.key for topic in wanted}
        for topic in ON_DEMAND:
            if topic.key in self._readers:
                self._bus.listen(self._readers[topic.key], topic.key in keys)
