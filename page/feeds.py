"""What the page reads, and when: what its panels are made of always, anything else only while somebody looks at it."""

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
    topics.PLANNING_SCENE, topics.DISPLAY_TRAJECTORY,  # seldom new; who opens the page may look back at them
)
LIVE, ANNOTATED, MASK, DEPTH = "live", "annotated", "mask", "depth"  # pictures
_LOG_SIZE = 2000  # lines that may wait


class Feeds:
    """A reader for each topic that the page has to do with."""

    def __init__(
        self, bus: Bus, always: Iterable[Topic[Any]], on_demand: Iterable[Topic[Any]] = ()
    ) -> None:
        """Declare the readers.

        Args:
            bus: of the service.
            always: what is read all the time.
            on_demand: what is read while `listen` says so; events are read all the time, since each counts.
        """
        self._bus = bus
        self._readers: dict[str, Reader[Any]] = {}
        self._topics: dict[str, Topic[Any]] = {}
        self._seen: dict[str, Message] = {}
        self._on_demand: set[str] = set()
        for topic, listening in [*((t, True) for t in always), *((t, t.kind == "event") for t in on_demand)]:
            if topic.key not in self._readers:
                self._readers[topic.key] = bus.reader(topic, size=_LOG_SIZE, listening=listening)
                self._topics[topic.key] = topic
                if not listening:
                    self._on_demand.add(topic.key)

    def __contains__(self, topic: Topic[Any]) -> bool:
        return topic.key in self._readers

    @property
    def topics(self) -> list[Topic[Any]]:
        """All that is read, always or on demand."""
        return list(self._topics.values())

    def reader(self, topic: Topic[M]) -> Reader[M] | None:
        """The reader of a topic, or None when the page does not read it."""
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
        for key in self._on_demand:
            self._bus.listen(self._readers[key], key in keys)


def under_all_keys(topic: Topic[M], tables: Iterable[Mapping[str, str]]) -> list[Topic[M]]:
    """A topic under each key that it has in a cell: two cameras say the same under different ones.

    Args:
        topic: in the words of the services.
        tables: the cell's keys by a service's own, of each service that has some.
    """
    keys = dict.fromkeys([topic.key, *(Remapping(table).key(topic.key) for table in tables)])
    return [replace(topic, key=key) for key in keys]


class HasTopics(Protocol):
    """A part of the page, or its class."""

    @property
    def TOPICS(self) -> Sequence[Topic[Any]]:
        """What it is shown."""


class Topics:
    """What the page has to do with: what every cell has, what the application names, and what layers show.

    Attributes:
        status, rejected, detected, decided_by: of the application, if it has them.
        images: pictures as the cameras send them, with what was found in them, what was looked at, and depth.
        requests: what the application asks.
        on_demand: what is read while somebody looks at it.
    """

    def __init__(
        self, application: Application | None, parts: Iterable[HasTopics], keys: Sequence[Mapping[str, str]] = ()
    ) -> None:
        """Look at what an application and parts of the page say, and what services call otherwise by their `keys`."""
        found, page = application.topics if application is not None else None, page_of(application)
        self.status: Topic[Any] | None = found.status if found is not None else None

        def everywhere(*wanted: Topic[Any] | None) -> list[Topic[Any]]:
            return [each for topic in wanted if topic is not None for each in under_all_keys(topic, keys)]

        self.rejected: list[Topic[Rejections]] = everywhere(found.rejected if found else None)
        self.detected: list[Topic[Any]] = everywhere(found.detected if found else None)
        self.decided_by: list[Topic[Any]] = everywhere(found.decided_by if found else None)
        self.images: dict[str, list[Topic[Image]]] = {
            LIVE: everywhere(topics.CAMERA_IMAGE, topics.DEPTH_CAMERA_IMAGE),
            ANNOTATED: everywhere(found.annotated if found else None),
            MASK: everywhere(found.mask if found else None),
            DEPTH: everywhere(topics.DEPTH_CAMERA_DEPTH),
        }
        self.requests: Sequence[Request[Any, Any]] = page.requests
        controls = getattr(page.controls, "TOPICS", ())
        shown = [topic for part in parts for topic in part.TOPICS]
        pictures = [topic for each in self.images.values() for topic in each]
        self.on_demand: list[Topic[Any]] = [*pictures, *controls, *shown]

    @property
    def always(self) -> list[Topic[Any]]:
        """What is read all the time: small or seldom."""
        return [*ALWAYS, *([self.status] if self.status is not None else []), *self.rejected,
                *self.detected, *self.decided_by]


class Latest(Protocol):
    """Where the newest message of a topic comes from: `Feeds.latest`."""

    def __call__(self, topic: Topic[M], /) -> M | None:
        """The newest message, or None."""


class Shows(HasTopics, Protocol):
    """A part of the page that shows messages."""

    @property
    def PERIOD(self) -> float:
        """Least time between two looks at what is new [s]."""

    def show(self, topic: Topic[Any], message: Any, /) -> None:
        """Show a message."""


class News:
    """Has a part of the page show the newest message of each of its topics, once, and no more often than it wants.

    Events are not among them: each counts, and is shown when it comes.
    """

    def __init__(self, part: Shows, latest: Latest) -> None:
        """Tell a part what is new."""
        self._part, self._latest = part, latest
        self._seen: dict[str, Message] = {}
        self._due = 0.0

    def tell(self, now: float) -> None:
        """Show what is new at a wall time [s], if it is time."""
        if now < self._due:
            return
        for topic in self._part.TOPICS:
            message = None if topic.kind == "event" else self._latest(topic)
            if message is not None and message is not self._seen.get(topic.key):
                self._seen[topic.key] = message
                self._due = now + self._part.PERIOD
                self._part.show(topic, message)


@dataclass
class Periods:
    """Wall time between two looks at a part of the page [s]."""

    picture: float = 0.1
    task: float = 0.2
    health: float = 0.25
    line: float = 0.25
    plots: float = 0.5
    memory: float = 0.1
    _due: dict[str, float] = field(default_factory=dict)

    def due(self, part: str, now: float) -> bool:
        """Whether it is time for a part at a wall time [s]; it is done then."""
        if now < self._due.get(part, 0.0):
            return False
        self._due[part] = now + float(getattr(self, part))
        return True

    def hurry_to(self, *parts: str) -> None:
        """Have it be time for some parts."""
        for part in parts:
            self._due.pop(part, None)

    def hurry(self) -> None:
        """Have it be time for everything: somebody has come who has seen nothing yet."""
        self._due.clear()
