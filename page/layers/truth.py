"""Where everything really is, as wireframes; while the simulated world is edited, things can be pulled about."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from common import topics
from common.messages import WorldObject
from common.topics import Topic
from page.layers import Layer
from page.nodes import FLAT, Rgb, add_triangles, position_of, wxyz_of

TRUTH = (0, 229, 255)
EDITED = (255, 255, 0)
_COLOR = -3  # of what tells a look: the last three are the colour, which is not shown
_FREE = ("table", "contained", "elsewhere")  # what may be pulled: not what the hand holds, nor what falls
_MOST_WORK = 2_000_000  # squares of the corners of all: to cut up more would keep the page from whoever presses STOP
_LARGER = 1.03  # a sphere is drawn a little outside of what was perceived
_LEAST_SLOPE = 1e-3  # of a line of sight that meets the plane anywhere near


class Truth(Layer):
    """Objects of the simulated world, of any shape."""

    LABEL = "Truth (simulated hardware)"
    ON = False
    TOPICS = (topics.SCENE_OBJECTS,)
    LEGEND = (("where it really is", TRUTH), ("the same, to be dragged", EDITED))
    EDITS = True

    def build(self) -> None:
        """Start without any."""
        self._numbers = count()
        self._editing = False
        self._nodes: dict[str, tuple[Any, Any]] = {}  # by id: what it looks like, its node
        self._things: dict[str, WorldObject] = {}
        self._drags: dict[str, Drag] = {}

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these objects and no others; of more than there is room for, the first."""
        from common.sim.objects import appearance_of  # brings shapes, which only a scene needs

        self._things, work = {}, 0
        for thing in message.objects:
            work += len(thing.polygon) ** 2
            if work <= _MOST_WORK:
                self._things[thing.id] = thing
        looks = {name: appearance_of(thing)[:_COLOR] for name, thing in self._things.items()}
        for name in [name for name, (look, _) in self._nodes.items() if looks.get(name) != look]:
            if name in self._drags:
                self._drags.pop(name).stop()
            self._nodes.pop(name)[1].remove()
        for name, thing in self._things.items():
            if name not in self._nodes:
                self._nodes[name] = (looks[name], self._add(thing))
            node = self._nodes[name][1]
            if not (name in self._drags and self._drags[name].held):
                node.position = position_of(thing.pose)
                if thing.shape != "sphere":
                    node.wxyz = wxyz_of(thing.pose)
        self._listen()

    def _add(self, thing: WorldObject) -> Any:
        from common.sim.objects import solid_of_message

        name = f"{self.root}/{next(self._numbers)}"
        if thing.shape == "sphere":
            return self.scene.add_icosphere(
                name, _LARGER * thing.size.x / 2, self._color, subdivisions=2, wireframe=True, **FLAT)
        return add_triangles(self.scene, name, solid_of_message(thing).triangles, self._color, wireframe=True)

    def edit(self, on: bool) -> None:
        """Let things be pulled about, or not."""
        self._editing = on
        for _, node in self._nodes.values():
            node.color = self._color
        self._listen()

    def node(self, name: str) -> Any:
        """The node of an object by its id; None when there is none."""
        return self._nodes.get(name, (None, None))[1]

    @property
    def _color(self) -> Rgb:
        return EDITED if self._editing else TRUTH

    def _listen(self) -> None:
        for name, (_, node) in self._nodes.items():
            wanted = self._editing and self._things[name].state in _FREE
            if wanted and name not in self._drags:
                self._drags[name] = Drag(node, partial(self._dropped, name), partial(self._picked, name))
            elif not wanted and name in self._drags:
                self._drags.pop(name).stop()

    def _picked(self, name: str) -> None:
        console = self.stage.console
        console.put(lambda: console.picked(name))

    def _dropped(self, name: str, x: float, y: float) -> None:
        """Ask for the middle of an object to lie where it was dropped by the origin of its frame."""
        from common.sim.objects import centre_of

        thing, console = self._things[name], self.stage.console
        centre, origin = centre_of(thing), position_of(thing.pose)
        x, y = x + centre[0] - origin[0], y + centre[1] - origin[1]
        console.put(lambda: console.move(name, x, y))


class Drag:
    """Lets a node be dragged at its own height until `stop`; it goes back to where it was when it is dropped."""

    def __init__(self, node: Any, dropped: Callable[[float, float], None], picked: Callable[[], None]) -> None:
        """Listen to the node. `dropped` is called with where it was let go, x, y [m]; `picked` when it is touched."""
        self._node, self._picked = node, picked
        self._dropped = dropped
        self._home = np.zeros(3)
        self._grip = np.zeros(2)
        self._held = False
        node.on_drag(self._on_drag)
        node.on_click(self._on_click)

    @property
    def held(self) -> bool:
        """Whether somebody drags it now."""
        return self._held

    def stop(self) -> None:
        """Listen no longer; what is held just now goes back to where it was."""
        if self._held:
            self._held = False
            self._node.position = self._home
        self._node.remove_drag_callback(self._on_drag)
        self._node.remove_click_callback(self._on_click)

    async def _on_click(self, _event: object) -> None:
        self._picked()

    async def _on_drag(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        """Follow the pointer: viser keeps the order of the phases for coroutines only."""
        eye = event.client.camera.position
        if event.phase == "start":
            self._picked()
            self._home = self._node.position.copy()
            grip = on_plane(eye, event.start_position, float(self._home[2]))
            self._held = grip is not None
            self._grip = np.array(grip or (0.0, 0.0)) - self._home[:2]
            return
        if not self._held:
            return
        at = on_plane(eye, event.end_position, float(self._home[2]))
        place = self._node.position[:2].copy() if at is None else np.array(at) - self._grip
        if event.phase == "update":
            self._node.position = (*place, self._home[2])
            return
        self._held = False
        self._node.position = self._home
        self._dropped(float(place[0]), float(place[1]))


def on_plane(eye: ArrayLike, through: ArrayLike, z: float) -> tuple[float, float] | None:
    """Where the line of sight from the eye through a point meets the plane at height z [m]; None: behind or never."""
    start, point = np.asarray(eye, dtype=float), np.asarray(through, dtype=float)
    way = point - start
    if abs(way[2]) < _LEAST_SLOPE * float(np.linalg.norm(way)):
        return None
    t = (z - start[2]) / way[2]
    if t <= 0:
        return None
    x, y = start[:2] + t * way[:2]
    return float(x), float(y)
