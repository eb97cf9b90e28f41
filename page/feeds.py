"""Topics that the page reads: those of its panels always, all others only while a page displays them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from common import topics
from common.application import Application
from common.messages import Image, Message, Rejections
from common.remapping import Remapping
from common.topics import Request, Topic
from page.application import page_of

if TYPE_CHECKING:
    from common.transport.bus import Bus
    from common.transport.reader import Reader

M = TypeVar("M", bound=Message)

ALWAYS: tuple[Topic[Any], ...] = (
    topics.JOINT_STATES, topics.MOTION_STATUS, topics.MOTION_OWNER, topics.ROBOT_STATUS, topics.GRIPPER_STATE,
    topics.SUPERVISOR_STATUS, topics.COUNTERS, topics.LOG,
    topics.PLANNING_SCENE, topics.DISPLAY_TRAJECTORY,  # published rarely; the history needs them
)
LIVE, ANNOTATED, MASK, DEPTH = "live", "annotated", "mask", "depth"  # kinds of images
_LOG_QUEUE = 2000  # log lines


class Feeds:
    """A reader for each topic of the page."""

    def __init__(
        self, bus: Bus, always: Iterable[Topic[Any]], on_demand: Iterable[Topic[Any]] = ()
    ) -> None:
        """Declare the readers.

        Args:
            bus: of the service.
            always: topics that are always read.
            on_demand: topics that are read while `select` selects them; of these, events are always read.
        """
        self._bus = bus
        self._readers: dict[str, Reader[Any]] = {}
        self._topics: dict[str, Topic[Any]] = {}
        self._taken: dict[str, Message] = {}
        self._on_demand: set[str] = set()
        for topic, listening in [*((t, True) for t in always), *((t, t.kind == "event") for t in on_demand)]:
            if topic.key not in self._readers:
                self._readers[topic.key] = bus.reader(topic, size=_LOG_QUEUE, listening=listening)
                self._topics[topic.key] = topic
                if not listening:
                    self._on_demand.add(topic.key)

    def __contains__(self, topic: Topic[Any]) -> bool:
        return topic.key in self._readers

    @property
    def topics(self) -> list[Topic[Any]]:
        """All topics, always read or on demand."""
        return list(self._topics.values())

    def reader(self, topic: Topic[M]) -> Reader[M] | None:
        """Return the reader of a topic, or None if the page does not read it."""
        return self._readers.get(topic.key)

    def latest(self, topic: Topic[M]) -> M | None:
        """Return the newest message of a topic, or None."""
        reader = self._readers.get(topic.key)
        return reader.latest if reader is not None else None

    def take(self, topic: Topic[M]) -> M | None:
        """Return the newest message of a topic if this method has not returned it yet."""
        message = self.latest(topic)
        if message is None or message is self._taken.get(topic.key):
            return None
        self._taken[topic.key] = message
        return message

    def select(self, selected: Iterable[Topic[Any]]) -> None:
        """Read these on-demand topics and no others."""
        keys = {topic.key for topic in selected}
        for key in self._on_demand:
            self._bus.listen(self._readers[key], key in keys)


def remapped_topics(topic: Topic[M], tables: Iterable[Mapping[str, str]]) -> list[Topic[M]]:
    """Return a topic under each key that it has in a cell, such as one per camera.

    Args:
        topic: as the services name it.
        tables: remappings of the services: the cell's keys by the service's own.
    """
    keys = dict.fromkeys([topic.key, *(Remapping(table).key(topic.key) for table in tables)])
    return [replace(topic, key=key) for key in keys]


class HasTopics(Protocol):
    """A part of the page, or its class."""

    @property
    def TOPICS(self) -> Sequence[Topic[Any]]:
        """Topics that it displays."""


class Topics:
    """Topics and requests of a page: those of every cell, of the application, and of the layers.

    Attributes:
        status, rejected, detected, decided_by: of the application, if it has them.
        images: topics of each kind of image.
        requests: of the application.
        on_demand: topics that are read while a page displays them.
    """

    def __init__(
        self, application: Application | None, parts: Iterable[HasTopics], keys: Sequence[Mapping[str, str]] = ()
    ) -> None:
        """Collect the topics of an application and of parts of the page, under the remapped `keys` of the services."""
        found, page = application.topics if application is not None else None, page_of(application)

        def remapped(*some: Topic[Any] | None) -> list[Topic[Any]]:
            return [each for topic in some if topic is not None for each in remapped_topics(topic, keys)]

        self.status: Topic[Any] | None = found.status if found else None
        self.rejected: list[Topic[Rejections]] = remapped(found.rejected if found else None)
        self.detected: list[Topic[Any]] = remapped(found.detected if found else None)
        self.decided_by: list[Topic[Any]] = remapped(found.decided_by if found else None)
        self.images: dict[str, list[Topic[Image]]] = {
            LIVE: remapped(topics.CAMERA_IMAGE, topics.DEPTH_CAMERA_IMAGE),
            ANNOTATED: remapped(found.annotated if found else None),
            MASK: remapped(found.mask if found else None),
            DEPTH: remapped(topics.DEPTH_CAMERA_DEPTH),
        }
        self.requests: Sequence[Request[Any, Any]] = page.requests
        controls = getattr(page.controls, "TOPICS", ())
        displayed = [topic for part in parts for topic in part.TOPICS]
        images = [topic for each in self.images.values() for topic in each]
        self.on_demand: list[Topic[Any]] = [topics.WRENCH, *images, *controls, *displayed]

    @property
    def always(self) -> list[Topic[Any]]:
        """Topics that are always read: small or rarely published."""
        return [*ALWAYS, *([self.status] if self.status is not None else []), *self.rejected,
                *self.detected, *self.decided_by]


class Latest(Protocol):
    """Source of the newest message of a topic, such as `Feeds.latest`."""

    def __call__(self, topic: Topic[M], /) -> M | None:
        """Return the newest message, or None."""


class MessageView(HasTopics, Protocol):
    """A part of the page that displays messages."""

    @property
    def PERIOD(self) -> float:
        """Minimum time between two updates [s]."""

    def show(self, topic: Topic[Any], message: Any, /) -> None:
        """Display a message."""


class Updater:
    """Passes the newest message of each topic to a part of the page, once, at most every `PERIOD`.

    Events are excluded: all of them are displayed, as they arrive.
    """

    def __init__(self, part: MessageView, latest: Latest) -> None:
        """Update a part of the page."""
        self._part, self._latest = part, latest
        self._shown: dict[str, Message] = {}
        self._next = 0.0

    def update(self, now: float) -> None:
        """Display new messages at a wall time [s], if the period is over."""
        if now < self._next:
            return
        for topic in self._part.TOPICS:
            message = None if topic.kind == "event" else self._latest(topic)
            if message is not None and message is not self._shown.get(topic.key):
                self._shown[topic.key] = message
                self._next = now + self._part.PERIOD
                self._part.show(topic, message)


@dataclass
class Schedule:
    """Wall time between two updates of each part of the page [s]."""

    images: float = 0.1
    task: float = 0.2
    diagnostics: float = 0.25
    status_bar: float = 0.25
    plots: float = 0.5
    history: float = 0.1
    _next: dict[str, float] = field(default_factory=dict)

    def is_due(self, part: str, now: float) -> bool:
        """Return whether a part is to be updated at a wall time [s], and schedule its next update."""
        if now < self._next.get(part, 0.0):
            return False
        self._next[part] = now + float(getattr(self, part))
        return True

    def hasten(self, *parts: str) -> None:
        """Make parts due now; without a name all of them."""
        for part in parts or list(self._next):
            self._next.pop(part, None)
