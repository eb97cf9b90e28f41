"""Applications: what a cell is for. The platform names none; it finds them.

An application is a package of applications, or a dotted module of a person's own, which may be a single file.
What it brings lies in modules of these names within the package, or else in the file itself:

    topics    its keys as `Topic` and `Request`, with their messages; and, by these names, the ones that all look for:
                STATUS     on which its task says how far it is: a `Topic` of a `TaskStatus`
                DECIDED_BY (optional) a stream whose stamp is that of the picture by which the task decides
                REJECTED   (optional) a `Topic` of `Rejections`: what the task is not offered, and why
                DETECTED   (optional) a `Topic` of `MarkerArray`: what was found, in world; a rejection of what is found
                           there no more is over
                ANNOTATED  (optional) a `Topic` of `Image`: the picture with what was found in it
                MASK       (optional) a `Topic` of `Image`: white where that was looked for
                VIEWS      (optional) {Topic: function(WorldObjects) -> message}: truth as the application calls it,
                           published by whoever simulates the world
    figures   (optional) what the summary, the report and the recheck say of a run
    truth     (optional) `wrong_in(WorldObjects) -> str`: what is wrong with where things really are when the task says
              DONE, in words; empty when nothing is. For the evaluation of a simulated run only
    page      (optional) labels and layers of the operator's page
    recording (optional) how its messages are written for other tools, as recording/foxglove.py says
    verbs     (optional) verbs of the command line, as common/verbs.py says
    checks    (optional) what `zencell check` finds beside its own, as generators of findings: `quick(cell)`, from the
                files alone, and `reach(cell, arm)`, with an arm of tools/check/arm.py
    reach     (optional) for `zencell robot new --cell`:
                fitted(RobotModel, tree of a cell file) -> that tree with a world in reach of the robot
    double    (optional) a service, with `Config` and `run`, that stands for its perception in `simulate --doubles`:
                REPLACES   kinds of the services that it stands for
                SETTINGS   (optional) of a cell in which it does, as of `--set`: what makes a run short

`TASK` in the package itself names the service that decides; without it the cell's `task` does. `GRASPS = True` says
that the task takes objects in the hand, `FILLS = True` that `done` of its status counts those in containers.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

from common.errors import ConfigError, UnknownName
from common.plugins import find_plugin, plugin_names

if TYPE_CHECKING:  # they take longer to load than a person at the command line wants to wait
    from common.messages import Message, TaskStatus, WorldObjects
    from common.topics import AnyTopic, Request, Topic

GROUP = "zencell.applications"


@dataclass(frozen=True)
class Application:
    """An application by its name in applications, or by that of its own dotted module."""

    name: str

    @property
    def module(self) -> ModuleType:
        """The package, or the single file."""
        return find_plugin(GROUP, self.name, field="application", noun="application")

    def part(self, name: str) -> ModuleType | None:
        """The module of that name within the package, or None; a single file is all parts of itself."""
        module = self.module
        if not hasattr(module, "__path__"):
            return module
        full = f"{module.__name__}.{name}"
        return importlib.import_module(full) if importlib.util.find_spec(full) else None

    def find(self, part: str, name: str) -> Any:
        """What a part calls by that name, or None."""
        return getattr(self.part(part), name, None)

    @property
    def task(self) -> str:
        """The service that decides; empty when the cell says it."""
        return str(getattr(self.module, "TASK", ""))

    @property
    def grasps(self) -> bool:
        """Whether its task takes objects in the hand, which then may slip."""
        return bool(getattr(self.module, "GRASPS", False))

    @property
    def fills(self) -> bool:
        """Whether what its task has done lies in containers."""
        return bool(getattr(self.module, "FILLS", False))

    @property
    def status(self) -> Topic[TaskStatus]:
        """Where the task says how far it is.

        Raises:
            ConfigError: the module is no application.
        """
        from common.messages import TaskStatus
        from common.topics import Topic

        found = self.find("topics", "STATUS")
        if not isinstance(found, Topic) or not issubclass(found.message, TaskStatus):
            raise ConfigError("application", self.name, "is no application: its topics have no STATUS")
        return cast("Topic[TaskStatus]", found)

    @property
    def views(self) -> dict[Topic[Any], Callable[[WorldObjects], Message]]:
        """What the truth is called in the application: a message for each of these topics, made of the world's."""
        return self.find("topics", "VIEWS") or {}

    @property
    def double(self) -> ModuleType | None:
        """The service that stands for its perception in a simulation, or None."""
        found = self.part("double")
        return found if hasattr(found, "REPLACES") else None

    @property
    def wrong_in(self) -> Callable[[WorldObjects], str] | None:
        """What is wrong with the truth at the end, in words; None for an application that does not judge it."""
        found: Callable[[WorldObjects], str] | None = self.find("truth", "wrong_in")
        return found

    @property
    def topics(self) -> dict[str, AnyTopic]:
        """Its own topics by key, in the order of its file."""
        return _topics_in(self.part("topics"))


def application_names() -> list[str]:
    """Applications that come with the project."""
    return plugin_names(GROUP)


def applications() -> Iterator[Application]:
    """Those that come with the project."""
    return (Application(name) for name in application_names())


def find_application(name: str) -> Application:
    """The application of that name.

    Raises:
        UnknownName: there is none; lists the choices.
        ConfigError: a dotted module that cannot be imported.
    """
    if "." not in name and name not in application_names():
        raise UnknownName("application", name, application_names())
    found = Application(name)
    look_where_one_stands()
    _ = found.module
    return found


def look_where_one_stands() -> None:
    """Have modules of a person's own found in the working directory, after all others."""
    _look_in(str(Path.cwd()))


def look_beside(cell: str) -> None:
    """Have modules found about the file of a cell, after all others."""
    _look_in(*places_beside(cell))


def places_beside(cell: str) -> list[str]:
    """The folder of a cell file, and the one around it, where the former is a package; none for a cell's name."""
    if not cell.endswith((".yaml", ".yml")):
        return []
    folder = Path(cell).expanduser().resolve().parent
    return [str(folder), str(folder.parent)]


def _look_in(*places: str) -> None:
    sys.path.extend(place for place in places if place not in sys.path)


def application_of_task(task: str) -> str:
    """The application of a cell file that names only its task; one with a task of its own gets the usual one."""
    for found in applications():
        if found.task == task:
            return found.name
    return next((found.name for found in applications() if getattr(found.module, "FOR_ANY_TASK", False)), "")


@cache
def all_topics() -> dict[str, AnyTopic]:
    """Every topic of the platform and of the applications that come with it, by key."""
    from common.topics import platform_topics

    known = dict(platform_topics())
    for found in applications():
        known |= found.topics
    return known


def find_topic(key: str) -> Topic[Any] | Request[Any, Any] | None:
    """The topic or request of a key, also of one service's log or parameters; None for one that is not known."""
    from common.topics import general_key, of_service

    topic, service = all_topics().get(general_key(key)), key.partition("/")[2]
    return topic if topic is None or not service.isidentifier() else of_service(topic, service)


def bring_in(modules: Iterable[str]) -> dict[str, AnyTopic]:
    """Topics by key that modules of a person's own bring; their messages are known from now on.

    One that cannot be imported brings none: the service that it is says why.
    """
    look_where_one_stands()
    found: dict[str, AnyTopic] = {}
    for name in modules:
        with suppress(Exception):
            found |= {**_topics_in(importlib.import_module(name)), **Application(name).topics}
    return found


@cache
def _message_classes() -> dict[str, type[Message]]:
    """Those of the platform and of the applications that come with it, by name."""
    from common import messages

    parts = (found.part("messages") for found in applications())
    modules = [*(part for part in parts if part is not None), messages]  # the platform's win
    return {name: found for module in modules for name, found in vars(module).items()
            if isinstance(found, type) and issubclass(found, messages.Message)}


def message_class(name: str) -> type[Message] | None:
    """The message class of that name, of the platform, of an application, or of any module that was imported."""
    return _message_classes().get(name) or next((found for found in _imported() if found.__name__ == name), None)


def _imported() -> Iterator[type[Message]]:
    from common.messages import Message

    left = [Message]
    while left:
        found = left.pop()
        yield found
        left += found.__subclasses__()


def _topics_in(module: ModuleType | None) -> dict[str, AnyTopic]:
    from common.topics import Request, Topic, platform_topics

    found = vars(module).values() if module is not None else ()
    shared = platform_topics()
    return {t.key: t for t in found if isinstance(t, Topic | Request) and t.key not in shared}
