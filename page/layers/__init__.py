"""Layers of the 3D scene. Each has a checkbox; layers are found by name.

The modules of this package are in every cell. An application adds layers in `Application.page`, and a user adds custom
ones with `services.viewer.layers: [my_pkg.my_layer]`. Such a module has one or more classes derived from `Layer`, or is
a layer itself:

    LABEL = "Tool height"            # of the checkbox
    ON = True                        # (optional) whether it is shown by default
    PERIOD = 0.0                     # (optional) minimum time between two updates [s]
    LEGEND = (("tool", (255, 0, 0)),)  # (optional) meaning of its colors, red, green and blue from 0 to 255
    TOPICS = (TF,)                   # `show` receives the newest message of each, while the layer is visible

    def show(layer: Layer, topic: Topic[Any], message: Any) -> None:
        layer.scene.add_label(f"{layer.root}/height", ...)      # viser: replaces the node of the same name
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from common import topics
from common.application import Application, applications
from common.errors import ConfigError, UnknownName
from common.messages import JointTrajectory
from common.topics import Topic
from page.application import page_of
from page.feeds import remapped_topics

if TYPE_CHECKING:
    import viser

    from common.config import Surroundings
    from common.robot.model import RobotModel
    from common.robot.visual_meshes import Piece
    from page.camera_panel import RgbImage
    from page.console import Console
    from page.feeds import Latest
    from page.figure import LinkPoses, Transforms
    from page.nodes import Projection

Rgb = tuple[int, int, int]

FIELD = "services.viewer.layers"
ATTRIBUTES = ("LABEL", "ON", "PERIOD", "LEGEND", "TOPICS", "show")  # of a module that is a layer
# Modules of this package, before and after the layers of an application and of the user.
FIRST, LAST = ("robot", "planning"), ("truth", "frames")
_POSE_TOPICS = {topics.TF.key, topics.TF_STATIC.key, topics.JOINT_STATES.key, topics.MOTION_STATUS.key}


@dataclass(frozen=True)
class Stage:
    """What a layer may use. Poses are in world."""

    scene: viser.SceneApi
    robot: RobotModel  # for kinematics, and the content of the robot file
    around: Surroundings  # cameras, fixtures and table
    console: Console  # for requests to the cell
    latest: Latest  # the newest message of a topic, of those that any part of the page reads
    clock: Callable[[], float]  # time [s] of animations
    poses: LinkPoses  # of the robot's links, now
    transforms: Transforms  # of frames, now
    pieces: list[Piece]  # meshes of the robot
    rough: list[Piece]  # the same with fewer triangles
    projection: Callable[[], Projection | None] = lambda: None  # of the browser for which labels are placed


class Layer:
    """A part of the scene that can be shown and hidden. Created and used by one thread at a time.

    Attributes:
        stage: robot, meshes, frames, newest messages, and the console for requests to the cell.
        scene: of viser, to which nodes are added.
        root: name of the parent of all its nodes, which is hidden with the layer.
    """

    NAME: ClassVar[str] = ""  # in the layout file; empty: the name of the class in snake case
    LABEL: ClassVar[str] = ""
    ON: ClassVar[bool] = True
    TOPICS: ClassVar[Sequence[Topic[Any]]] = ()
    PERIOD: ClassVar[float] = 0.0  # [s] wall: minimum time between two updates
    LEGEND: ClassVar[Sequence[tuple[str, Rgb]]] = ()  # meaning of its colors
    EDITS: ClassVar[bool] = False  # also visible while the simulated world is edited

    def __init__(self, stage: Stage, root: str) -> None:
        """Create the layer; see the attributes."""
        self.stage = stage
        self.scene: viser.SceneApi = stage.scene
        self.root = root
        self.build()

    def build(self) -> None:
        """Add the nodes that need no message."""

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Display a message of `TOPICS`: every event, and of other topics the newest while the layer is visible."""

    def show_image(self, topic: Topic[Any], rgb: RgbImage) -> None:
        """Display a live image of a camera, while it is displayed next to the scene."""

    def play(self, plan: JointTrajectory) -> None:
        """Animate a plan that an operator requested."""

    def compare(self, plan: JointTrajectory | None) -> None:
        """Animate another plan next to the first; None removes it."""

    def edit(self, on: bool) -> None:
        """Start or stop editing of the simulated world."""


Layers = Mapping[str, type[Layer]]


def has_data(kind: type[Layer], published: Collection[str]) -> bool:
    """Return whether a layer can display anything in a cell where these keys are published.

    Poses and the motion status are published in every cell, so they do not count if the layer has other topics.
    """
    keys = [topic.key for topic in kind.TOPICS if topic.key not in _POSE_TOPICS] or [
        topic.key for topic in kind.TOPICS]
    return not keys or any(key in published for key in keys)


def find_layers(
    application: Application | None, custom: Iterable[str] = (), keys: Sequence[Mapping[str, str]] = ()
) -> Layers:
    """Return the layers of a cell by name, in the order of their checkboxes.

    Args:
        application: of the cell.
        custom: dotted modules of the user.
        keys: remappings of the services; a layer shows its topics under these keys too.

    Raises:
        ConfigError: a module cannot be imported, or has no layer.
    """
    found: dict[str, type[Layer]] = {}
    for some in [*(layers_in(_import(name)) for name in FIRST), by_name(page_of(application).layers),
                 *(layers_in(_import_custom(name)) for name in custom)]:
        found |= some  # a later layer replaces one of the same name
    for module in map(_import, LAST):
        found = found | {name: kind for name, kind in layers_in(module).items() if name not in found}
    if keys:
        found = {name: type(kind.__name__, (kind,), {"TOPICS": [t for topic in kind.TOPICS
                                                               for t in remapped_topics(topic, keys)]})
                 for name, kind in found.items()}
    return found


def layers_in(module: ModuleType) -> dict[str, type[Layer]]:
    """Return the layers of a module by name."""
    classes = [kind for kind in vars(module).values()
               if isinstance(kind, type) and issubclass(kind, Layer) and kind.__module__ == module.__name__]
    found = by_name(classes)
    if callable(getattr(module, "show", None)) and hasattr(module, "TOPICS") and hasattr(module, "LABEL"):
        attributes = {name: vars(module)[name] for name in ATTRIBUTES if hasattr(module, name)}
        found[module.__name__] = type("ModuleLayer", (Layer,), attributes)
    return found


def by_name(classes: Iterable[type[Layer]]) -> dict[str, type[Layer]]:
    """Return layers by name; names of custom layers start with the name of their module."""
    found = {}
    for kind in classes:
        prefix = "" if kind.__module__.partition(".")[0] in ("page", "applications") else f"{kind.__module__}."
        found[prefix + (kind.NAME or re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower())] = kind
    return found


def shown_layers(configured: Mapping[str, bool], available: Layers) -> dict[str, bool]:
    """Return whether each available layer is shown: as configured, else its default.

    Raises:
        UnknownName: a configured layer exists neither here nor in any other cell; with the choices.
    """
    unknown = [name for name in configured if name not in available and "." not in name]
    if unknown:
        elsewhere = {name for other in applications() for name in by_name(page_of(other).layers)}
        for name in unknown:
            if name not in elsewhere:
                raise UnknownName("layer", name, list(available))
    return {name: configured.get(name, kind.ON) for name, kind in available.items()}


def _import(name: str) -> ModuleType:
    return importlib.import_module(f"{__name__}.{name}")


def _import_custom(name: str) -> ModuleType:
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(FIELD, name, f"cannot be imported: {error}") from None
    if not layers_in(module):
        raise ConfigError(FIELD, name, "has no layer: neither a class derived from Layer, nor LABEL, TOPICS and show()")
    return module
