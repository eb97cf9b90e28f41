"""What the 3D scene is made of: layers, each shown and hidden by a tick of its own, found by name as planners are.

Those of this package are in every cell; an application brings its own in `Application.page`, and a user names theirs as
`services.viewer.layers: [my_pkg.my_layer]`. Such a module has one or more classes derived from `Layer`, or is a layer
itself:

    LABEL = "Height of the tool"     # of the tick
    ON = True                        # (optional) whether it is shown when the page opens for the first time
    PERIOD = 0.0                     # (optional) least time between two looks at what is new [s]
    LEGEND = (("the tool", (255, 0, 0)),)  # (optional) what its colours mean, red, green and blue from 0 to 255
    TOPICS = (TF,)                   # the newest message of each comes to `show`, while somebody looks

    def show(layer: Layer, topic: Topic[Any], message: Any) -> None:
        layer.scene.add_label(f"{layer.root}/height", ...)      # viser: what is called as before replaces it
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from common import topics
from common.application import Application, applications
from common.errors import ConfigError, UnknownName
from common.messages import JointTrajectory
from common.topics import Topic
from page.application import page_of
from page.feeds import under_all_keys

if TYPE_CHECKING:
    import viser

    from page.pictures import Picture
    from page.stage import Stage

Rgb = tuple[int, int, int]

FIELD = "services.viewer.layers"
SAYS = ("LABEL", "ON", "PERIOD", "LEGEND", "TOPICS", "show")  # of a module that is a layer
# Modules here; an application's own stand between them.
FIRST, LAST = ("robot", "reach", "planning_scene"), ("points", "truth", "frames")
_WHERE = {topics.TF.key, topics.TF_STATIC.key, topics.JOINT_STATES.key}


class Layer:
    """Something that can be shown and hidden. Made and used by one thread at a time.

    Attributes:
        stage: what it may look at: the robot, its meshes, where frames are, what the cell said last; and the console,
            by which a person's clicks reach the cell.
        scene: viser's, to which nodes are added.
        root: name of the node above all of its nodes, which is hidden with the layer.
    """

    NAME: ClassVar[str] = ""  # in the file of the layout; empty: that of the class, in small letters
    LABEL: ClassVar[str] = ""
    ON: ClassVar[bool] = True
    TOPICS: ClassVar[Sequence[Topic[Any]]] = ()
    PERIOD: ClassVar[float] = 0.0  # [s] wall: least time between two looks at what is new
    LEGEND: ClassVar[Sequence[tuple[str, Rgb]]] = ()  # what its colours mean
    EDITS: ClassVar[bool] = False  # also shown, and told, while the simulated world is edited

    def __init__(self, stage: Stage, root: str) -> None:
        """Take a place on the stage; see the attributes."""
        self.stage = stage
        self.scene: viser.SceneApi = stage.scene
        self.root = root
        self.build()

    def build(self) -> None:
        """Add what is there before any message."""

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show a message of one of `TOPICS`: of an event every one, else the newest, and only while it is seen."""

    def picture(self, topic: Topic[Any], rgb: Picture) -> None:
        """Take note of a picture as the camera sends it, while it is shown beside the scene."""

    def play(self, plan: JointTrajectory) -> None:
        """Show how the robot would move along a plan that a person asked for."""

    def compare(self, plan: JointTrajectory | None) -> None:
        """Show another plan beside the one that is played; None: none any more."""

    def edit(self, on: bool) -> None:
        """Let a person change the simulated world, or not."""


Layers = Mapping[str, type[Layer]]


def has_something(kind: type[Layer], written: Collection[str]) -> bool:
    """Whether a layer has anything to show in a cell in which these keys are written.

    Where things are is written in every cell: what else a layer is about counts, if there is anything else.
    """
    about = [topic.key for topic in kind.TOPICS if topic.key not in _WHERE] or [topic.key for topic in kind.TOPICS]
    return not about or any(key in written for key in about)


def find_layers(
    application: Application | None, own: Iterable[str] = (), keys: Sequence[Mapping[str, str]] = ()
) -> Layers:
    """The layers of a cell by name, in the order of their ticks.

    Args:
        application: what the cell is for.
        own: dotted modules of a person.
        keys: of services that call topics otherwise: a layer shows these topics, too.

    Raises:
        ConfigError: a module cannot be imported, or has no layer.
    """
    found: dict[str, type[Layer]] = {}
    for brought in [*(layers_in(_import(name)) for name in FIRST), named(page_of(application).layers),
                    *(layers_in(_import_own(name)) for name in own)]:
        found |= brought  # a layer replaces one of the same name
    for module in map(_import, LAST):
        found = found | {name: kind for name, kind in layers_in(module).items() if name not in found}
    if keys:
        found = {name: type(kind.__name__, (kind,), {"TOPICS": [t for topic in kind.TOPICS
                                                               for t in under_all_keys(topic, keys)]})
                 for name, kind in found.items()}
    return found


def layers_in(module: ModuleType) -> dict[str, type[Layer]]:
    """The layers that a module brings; the names of those that do not come with the project begin with the module's."""
    classes = [kind for kind in vars(module).values()
               if isinstance(kind, type) and issubclass(kind, Layer) and kind.__module__ == module.__name__]
    found = named(classes)
    if callable(getattr(module, "show", None)) and hasattr(module, "TOPICS") and hasattr(module, "LABEL"):
        says = {name: vars(module)[name] for name in SAYS if hasattr(module, name)}
        found[module.__name__] = type("OwnLayer", (Layer,), says)
    return found


def named(classes: Iterable[type[Layer]]) -> dict[str, type[Layer]]:
    """Layers by name; names of layers that are not part of the project start with the name of their module."""
    found = {}
    for kind in classes:
        prefix = "" if kind.__module__.partition(".")[0] in ("page", "applications") else f"{kind.__module__}."
        found[prefix + (kind.NAME or re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower())] = kind
    return found


def layers_shown(wanted: Mapping[str, bool], here: Layers) -> dict[str, bool]:
    """Whether each layer that is here is shown: as wanted, else as it says itself.

    Raises:
        UnknownName: a wanted layer is neither here nor in another cell; with the choices.
    """
    unknown = [name for name in wanted if name not in here and "." not in name]
    if unknown:
        elsewhere = {name for other in applications() for name in named(page_of(other).layers)}
        for name in unknown:
            if name not in elsewhere:
                raise UnknownName("layer", name, list(here))
    return {name: wanted.get(name, kind.ON) for name, kind in here.items()}


def _import(name: str) -> ModuleType:
    return importlib.import_module(f"{__name__}.{name}")


def _import_own(name: str) -> ModuleType:
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(FIELD, name, f"cannot be imported: {error}") from None
    if not layers_in(module):
        raise ConfigError(FIELD, name, "has no layer: a class derived from Layer, or LABEL, TOPICS and show()")
    return module
