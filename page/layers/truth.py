"""Ground truth of the simulated world as wireframes, which can be dragged while the world is edited."""

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

TRUTH: Rgb = (0, 229, 255)
EDITED: Rgb = (255, 255, 0)
_COLOR_FIELDS = -3  # last fields of an object's appearance: its color, which a wireframe does not show
_DRAGGABLE = ("table", "contained", "elsewhere")  # states: neither grasped nor falling
_MAX_WORK = 2_000_000  # sum of the squared number of corners: triangulating more would block the page, STOP included
_ENLARGED = 1.03  # a sphere is drawn slightly larger than the perceived one
_MIN_SLOPE = 1e-3  # of a line of sight, to intersect a horizontal plane at a reasonable distance


class Truth(Layer):
    """The objects of the simulated world, of any shape."""

    LABEL = "Ground truth (simulation)"
    ON = False
    TOPICS = (topics.SCENE_OBJECTS,)
    LEGEND = (("ground truth", TRUTH), ("ground truth, draggable", EDITED))
    EDITS = True

    def build(self) -> None:
        """Start empty."""
        self._numbers = count()
        self._editing = False
        self._nodes: dict[str, tuple[Any, Any]] = {}  # appearance and node, by id
        self._objects: dict[str, WorldObject] = {}
        self._drags: dict[str, Drag] = {}

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Replace the displayed objects; beyond `_MAX_WORK` the rest is left out."""
        from common.sim.objects import appearance_of  # slow to import, and needed with a scene only

        self._objects, work = {}, 0
        for thing in message.objects:
            work += len(thing.polygon) ** 2
            if work <= _MAX_WORK:
                self._objects[thing.id] = thing
        appearance = {name: appearance_of(thing)[:_COLOR_FIELDS] for name, thing in self._objects.items()}
        for name in [name for name, (shown, _) in self._nodes.items() if appearance.get(name) != shown]:
            if name in self._drags:
                self._drags.pop(name).stop()
            self._nodes.pop(name)[1].remove()
        for name, thing in self._objects.items():
            if name not in self._nodes:
                self._nodes[name] = (appearance[name], self._add(thing))
            node = self._nodes[name][1]
            if not (name in self._drags and self._drags[name].active):
                node.position = position_of(thing.pose)
                if thing.shape != "sphere":
                    node.wxyz = wxyz_of(thing.pose)
        self._update_drags()

    def _add(self, thing: WorldObject) -> Any:
        from common.sim.objects import solid_of_message

        name = f"{self.root}/{next(self._numbers)}"
        if thing.shape == "sphere":
            return self.scene.add_icosphere(
                name, _ENLARGED * thing.size.x / 2, self._color, subdivisions=2, wireframe=True, **FLAT)
        return add_triangles(self.scene, name, solid_of_message(thing).triangles, self._color, wireframe=True)

    def edit(self, on: bool) -> None:
        """Make objects draggable, or not."""
        self._editing = on
        for _, node in self._nodes.values():
            node.color = self._color
        self._update_drags()

    def node(self, name: str) -> Any:
        """Return the node of an object by its id, or None."""
        return self._nodes.get(name, (None, None))[1]

    @property
    def _color(self) -> Rgb:
        return EDITED if self._editing else TRUTH

    def _update_drags(self) -> None:
        for name, (_, node) in self._nodes.items():
            draggable = self._editing and self._objects[name].state in _DRAGGABLE
            if draggable and name not in self._drags:
                self._drags[name] = Drag(node, partial(self._drop, name), partial(self._select, name))
            elif not draggable and name in self._drags:
                self._drags.pop(name).stop()

    def _select(self, name: str) -> None:
        console = self.stage.console
        console.put(lambda: console.on_object_selected(name))

    def _drop(self, name: str, x: float, y: float) -> None:
        """Request that an object is moved; x, y [m] is the new origin of its frame, an edit takes its center."""
        from common.sim.objects import centre_of

        thing, console = self._objects[name], self.stage.console
        center, origin = centre_of(thing), position_of(thing.pose)
        x, y = x + center[0] - origin[0], y + center[1] - origin[1]
        console.put(lambda: console.on_object_moved(name, x, y))


class Drag:
    """Makes a node draggable in the horizontal plane until `stop`; a dropped node returns to its position."""

    def __init__(self, node: Any, on_drop: Callable[[float, float], None], on_select: Callable[[], None]) -> None:
        """Listen to the node. `on_drop` is called with its new x, y [m], `on_select` when it is clicked."""
        self._node, self._on_select, self._on_drop = node, on_select, on_drop
        self._home = np.zeros(3)
        self._offset = np.zeros(2)  # from the node to the pointer
        self.active = False
        node.on_drag(self._handle_drag)
        node.on_click(self._handle_click)

    def stop(self) -> None:
        """Stop listening; a drag in progress is cancelled."""
        if self.active:
            self.active = False
            self._node.position = self._home
        self._node.remove_drag_callback(self._handle_drag)
        self._node.remove_click_callback(self._handle_click)

    async def _handle_click(self, _event: object) -> None:
        self._on_select()

    async def _handle_drag(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        """Follow the pointer. A coroutine, because viser keeps the order of the phases for coroutines only."""
        eye = event.client.camera.position
        if event.phase == "start":
            self._on_select()
            self._home = self._node.position.copy()
            grip = intersect_horizontal(eye, event.start_position, float(self._home[2]))
            self.active = grip is not None
            self._offset = np.array(grip or (0.0, 0.0)) - self._home[:2]
            return
        if not self.active:
            return
        at = intersect_horizontal(eye, event.end_position, float(self._home[2]))
        position = self._node.position[:2].copy() if at is None else np.array(at) - self._offset
        if event.phase == "update":
            self._node.position = (*position, self._home[2])
            return
        self.active = False
        self._node.position = self._home
        self._on_drop(float(position[0]), float(position[1]))


def intersect_horizontal(eye: ArrayLike, through: ArrayLike, z: float) -> tuple[float, float] | None:
    """Return x, y where the ray from the eye through a point meets the plane at height z [m]; None: never."""
    start, point = np.asarray(eye, dtype=float), np.asarray(through, dtype=float)
    direction = point - start
    if abs(direction[2]) < _MIN_SLOPE * float(np.linalg.norm(direction)):
        return None
    t = (z - start[2]) / direction[2]
    if t <= 0:
        return None
    x, y = start[:2] + t * direction[:2]
    return float(x), float(y)
