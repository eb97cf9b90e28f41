"""Applications: what a cell is used for. The platform names none; it finds them by name.

An application is a package of `applications/`, an installed entry point of the group `zencell.applications`, or a
dotted module of the user (a package or a single file). The module declares it as one object:

    APPLICATION = Application(topics=ApplicationTopics(status=STATUS), grasps=True)

Parts that take long to import are named instead: `page="my_app.page:PAGE"` is imported when the page is built.
"""

from __future__ import annotations

import copy
import importlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

from common.errors import ConfigError
from common.plugins import extend_path, find_plugin, import_from_working_directory, plugin_names

if TYPE_CHECKING:  # these imports take too long for the command line and shell completion
    from common.messages import Message, TaskStatus, WorldObjects
    from common.topics import AnyTopic, Request, Topic

T = TypeVar("T")

GROUP = "zencell.applications"
VARIABLE = "APPLICATION"


class Lazy(Generic[T]):
    """A field that holds a part itself, or the reference "package.module:NAME" that is imported on first access."""

    def __set_name__(self, owner: type, name: str) -> None:
        """Remember under which name the instance stores the value."""
        self._name, self._stored = name, f"_{name}"

    @overload
    def __get__(self, instance: None, owner: type) -> None: ...

    @overload
    def __get__(self, instance: object, owner: type) -> T | None: ...

    def __get__(self, instance: object | None, owner: type) -> T | None:
        """Return the part; None where the application has none.

        Raises:
            ConfigError: the reference cannot be imported.
        """
        if instance is None:
            return None  # the default value of the field
        found = vars(instance)[self._stored]
        if isinstance(found, str):
            found = vars(instance)[self._stored] = _imported_part(found, f"application.{self._name}")
        part: T | None = found
        return part

    def __set__(self, instance: object, value: T | str | None) -> None:
        """Store the part or its reference."""
        vars(instance)[self._stored] = value


@dataclass(frozen=True, kw_only=True)
class ApplicationTopics:
    """The topics of an application and what the platform uses them for."""

    status: Topic[Any]
    """State and progress, published by the task; its message derives from `TaskStatus`."""
    decided_by: Topic[Any] | None = None
    """Stream whose stamp is that of the image by which the task decides; its age is the perception latency."""
    rejected: Topic[Any] | None = None
    """`Rejections`: detections that the task is not offered, with the reason."""
    detected: Topic[Any] | None = None
    """`MarkerArray`: detections in world; a rejection ends once nothing is detected there any more."""
    annotated: Topic[Any] | None = None
    """`Image`: the camera image with the detections drawn in."""
    mask: Topic[Any] | None = None
    """`Image`: white where a pixel has a color that the detector looks for."""
    truth_views: Mapping[Topic[Any], Callable[[WorldObjects], Message]] = field(default_factory=dict)
    """Simulated ground truth in the messages of the application; the simulator publishes each under its topic."""
    of_arm: Sequence[Topic[Any] | Request[Any, Any]] = ()
    """Besides `status`: topics that each arm has for itself in a cell with several arms; all arms share the others."""
    declared: Sequence[Topic[Any] | Request[Any, Any]] = ()
    """All topics and requests of the application, in the order of the documentation."""

    @property
    def by_key(self) -> dict[str, AnyTopic]:
        """The application's topics and requests by key, without those of the platform."""
        from common.topics import Topic, platform_topics

        roles = (getattr(self, each.name) for each in fields(self))
        roles_given = (topic for topic in roles if isinstance(topic, Topic))
        found = [*self.declared, *self.of_arm, *roles_given, *self.truth_views]
        shared = platform_topics()
        return {topic.key: topic for topic in found if topic.key not in shared}


@dataclass(frozen=True, kw_only=True)
class Checks:
    """What `zencell check` finds in a cell of the application, each a generator of `tools.check.Finding`."""

    quick: Callable[..., Iterator[Any]] | None = None
    """`quick(cell)`: from the files alone."""
    reach: Callable[..., Iterator[Any]] | None = None
    """`reach(cell, arm)`: what needs the robot model, with a `tools.check.arm.Arm`."""


@dataclass(frozen=True, kw_only=True)
class SimulationDouble:
    """A service that replaces the perception of the application in `zencell simulate --doubles`."""

    module: str
    """Dotted name of the service module, with `Config` and `run`."""
    replaces: tuple[str, ...]
    """Kinds of the services that it replaces."""
    settings: tuple[str, ...] = ()
    """Values of the cell for such a run, as in `--set`: they make it short."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Application:
    """What an application brings. All but `topics` is optional."""

    topics: Lazy[ApplicationTopics] = Lazy()
    """Its topics; `status` is required."""
    task: str = ""
    """Service that decides; empty: the one that the cell file names as `task`, or the application's own module."""
    grasps: bool = False
    """Whether the task holds objects with the gripper, which then may slip."""
    fills_containers: bool = False
    """Whether `done` of the status counts objects in containers."""
    default: bool = False
    """Whether cell files that name a task but no application get this one."""
    figures: Lazy[Any] = Lazy()
    """Class derived from `recording.report.application.Figures`: what summary and report show of a run."""
    foxglove: Lazy[Sequence[Any]] = Lazy()
    """Converters of its messages for Foxglove, as `recording.foxglove.KINDS`."""
    truth_check: Lazy[Callable[[WorldObjects], str]] = Lazy()
    """Returns what is wrong with the simulated world once the task reports DONE, empty for nothing; evaluation only."""
    page: Lazy[Any] = Lazy()
    """`page.application.ApplicationPage`: layers, controls and labels on the operator's page."""
    verbs: Lazy[Any] = Lazy()
    """`common.verbs.Verbs`: commands of the command line and options of `zencell run`."""
    checks: Lazy[Checks] = Lazy()
    """What `zencell check` verifies besides its own checks."""
    fit_world: Lazy[Callable[..., dict[str, Any]]] = Lazy()
    """`fit_world(RobotModel, cell tree) -> cell tree` with a world within reach, for `zencell robot new --cell`."""
    double: SimulationDouble | None = None
    """Replacement of its perception in fast simulations."""
    name: str = field(default="", init=False)
    """Name under which it was found."""

    @property
    def status(self) -> Topic[TaskStatus]:
        """Topic on which the task reports its state and progress.

        Raises:
            ConfigError: the application declares none.
        """
        from common.messages import TaskStatus

        if self.topics is None or not issubclass(self.topics.status.message, TaskStatus):
            raise ConfigError("application", self.name, "declares no topic of a TaskStatus as its status")
        return self.topics.status

    @property
    def truth_views(self) -> Mapping[Topic[Any], Callable[[WorldObjects], Message]]:
        """Simulated ground truth in its own messages, by topic."""
        return self.topics.truth_views if self.topics is not None else {}

    @property
    def arm_keys(self) -> list[str]:
        """Keys of its topics that each arm has for itself in a cell with several arms."""
        return [topic.key for topic in (self.topics.status, *self.topics.of_arm)] if self.topics is not None else []

    @property
    def topics_by_key(self) -> dict[str, AnyTopic]:
        """Its own topics and requests by key."""
        return self.topics.by_key if self.topics is not None else {}


def application_names() -> list[str]:
    """Return the names of the installed applications."""
    return plugin_names(GROUP)


def applications() -> Iterator[Application]:
    """Yield the installed applications."""
    return (_load(name) for name in application_names())


def find_application(name: str) -> Application:
    """Return the application of that name; for no name one that brings nothing.

    Raises:
        UnknownName: no application has that plain name; lists the choices.
        ConfigError: a dotted module cannot be imported, or declares no application.
    """
    if not name:
        return Application()
    return _load(name)


def _load(name: str) -> Application:
    module = find_plugin(GROUP, name, field="application", noun="application")
    found = getattr(module, VARIABLE, None)
    if not isinstance(found, Application):
        raise ConfigError("application", name, f"is no application: the module has no {VARIABLE} = Application(...)")
    named = copy.copy(found)
    object.__setattr__(named, "name", name)
    return named


def _imported_part(reference: str, field_name: str) -> Any:
    module, _, name = reference.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(field_name, reference, f"cannot be imported: {error}") from None


def import_from_folder_of(cell: str) -> None:
    """Let Python import modules from the folder of a cell file and the folder around it, after all others."""
    extend_path(*import_folders(cell))


def import_folders(cell: str) -> list[str]:
    """Return the folder of a cell file and its parent, for a folder that is a package; [] for the name of a cell."""
    if not cell.endswith((".yaml", ".yml")):
        return []
    folder = Path(cell).expanduser().resolve().parent
    return [str(folder), str(folder.parent)]


def application_of_task(task: str) -> str:
    """Return the application of a cell file that names only its task; for a task of the user the default one."""
    for found in applications():
        if found.task == task:
            return found.name
    return next((found.name for found in applications() if found.default), "")


@cache
def all_topics() -> dict[str, AnyTopic]:
    """Return every topic of the platform and of the installed applications, by key."""
    from common.topics import platform_topics

    known = dict(platform_topics())
    for found in applications():
        known |= found.topics_by_key
    return known


def find_topic(key: str) -> Topic[Any] | Request[Any, Any] | None:
    """Return the topic or request of a key, also of one service's log or parameters; None for an unknown key."""
    from common.topics import general_key, of_service

    topic, service = all_topics().get(general_key(key)), key.partition("/")[2]
    return topic if topic is None or not service.isidentifier() else of_service(topic, service)


def import_topics(modules: Iterable[str]) -> dict[str, AnyTopic]:
    """Import modules of the user and return their topics by key; their messages are known from now on.

    A module that cannot be imported contributes none: the service that it implements reports the error.
    """
    found: dict[str, AnyTopic] = {}
    for name in modules:
        import_from_working_directory(name)
        with suppress(Exception):
            module = importlib.import_module(name)
            found |= _topics_in(module)
            if isinstance(declared := getattr(module, VARIABLE, None), Application):
                found |= declared.topics_by_key
    return found


@cache
def _message_classes() -> dict[str, type[Message]]:
    """Return the message classes of the installed applications and of the platform by name; the platform's win."""
    from common import messages
    from common.topics import Topic

    own = {topic.message.__module__ for found in applications() for topic in found.topics_by_key.values()
           if isinstance(topic, Topic)}
    modules = [*(sys.modules[name] for name in sorted(own)), messages]
    return {name: found for module in modules for name, found in vars(module).items()
            if isinstance(found, type) and issubclass(found, messages.Message)}


def message_class(name: str) -> type[Message] | None:
    """Return the message class of that name: of the platform, an application, or any imported module."""
    return _message_classes().get(name) or next((found for found in _imported() if found.__name__ == name), None)


def _imported() -> Iterator[type[Message]]:
    from common.messages import Message

    left = [Message]
    while left:
        found = left.pop()
        yield found
        left += found.__subclasses__()


def _topics_in(module: ModuleType) -> dict[str, AnyTopic]:
    from common.topics import Request, Topic, platform_topics

    shared = platform_topics()
    return {t.key: t for t in vars(module).values() if isinstance(t, Topic | Request) and t.key not in shared}
