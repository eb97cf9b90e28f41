"""Where everything really is, as wireframes; in the simulated world things can be pulled about."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

import viser

from common.messages import WorldObjects
from common.sim.objects import centre_of, look_of
from common.viewer.dragging import Drag
from common.viewer.poses import wxyz_of
from common.viewer.solids import add_world_object, middle_of

TRUTH = (0, 229, 255)
EDITED = (255, 255, 0)
_FREE = ("table", "contained", "elsewhere")  # what may be pulled: not what the hand holds, nor what falls


class Truth:
    """Objects of the simulated world."""

    def __init__(
        self, scene: viser.SceneApi, root: str, dragged: Callable[[str, float, float], None]
    ) -> None:
        """Start without any.

        Args:
            scene: to which nodes are added.
            root: name of the node under which they are put.
            dragged: called with the id of what was dropped somewhere, and x, y [m].
        """
        self._scene = scene
        self._root = root
        self._dragged = dragged
        self._numbers = count()
        self._editing = False
        self._nodes: dict[str, tuple[Any, Any]] = {}  # by id: what it looks like, its node
        self._free: dict[str, bool] = {}
        self._drags: dict[str, Drag] = {}
        self._off: dict[str, tuple[float, float]] = {}  # of the middle of what it covers from its node [m]

    def objects(self, m: WorldObjects) -> None:
        """Show these objects and no others."""
        things = {thing.id: thing for thing in m.objects}
        looks = {name: look_of(thing)[:-3] for name, thing in things.items()}
        self._keep([name for name, (look, _) in self._nodes.items() if looks.get(name) == look])
        for name, thing in things.items():
            if name not in self._nodes:
                node = add_world_object(self._scene, f"{self._root}/{next(self._numbers)}", thing, self._color)
                self._nodes[name] = (looks[name], node)
            place, node = middle_of(thing), self._nodes[name][1]
            self._free[name] = thing.state in _FREE
            self._off[name] = (centre_of(thing)[0] - place[0], centre_of(thing)[1] - place[1])
            if not (name in self._drags and self._drags[name].held):
                node.position = place
                if thing.shape != "sphere":
                    node.wxyz = wxyz_of(thing.pose)
        self._listen()

    def set_editing(self, on: bool) -> None:
        """Let things be pulled about, or not."""
        self._editing = on
        for _, node in self._nodes.values():
            node.color = self._color
        self._listen()

    def node(self, name: str) -> Any:
        """The node of an object by its id; None when there is none."""
        return self._nodes.get(name, (None, None))[1]

    @property
    def _color(self) -> tuple[int, int, int]:
        return EDITED if self._editing else TRUTH

    def _keep(self, names: list[str]) -> None:
        for name in [name for name in self._nodes if name not in names]:
            if name in self._drags:
                self._drags.pop(name).stop()
            self._nodes.pop(name)[1].remove()

    def _listen(self) -> None:
        for name, (_, node) in self._nodes.items():
            wanted = self._editing and self._free[name]
            if wanted and name not in self._drags:
                self._drags[name] = Drag(node, lambda x, y, name=name: self._drop(name, x, y))  # type: ignore[misc]
            elif not wanted and name in self._drags:
                self._drags.pop(name).stop()

    def _drop(self, name: str, x: float, y: float) -> None:
        """Tell of a node that was dropped where the middle of what it covers is to lie."""
        off = self._off[name]
        self._dragged(name, x + off[0], y + off[1])
