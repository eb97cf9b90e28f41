"""Where everything really is, as wireframes; in the simulated world things can be pulled about."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

import viser

from common.messages import PoseArray, WorldObject, WorldObjects
from common.sim.objects import centre_of
from common.viewer.dragging import Drag
from common.viewer.poses import position_of
from common.viewer.solids import add_world_object

TRUTH = (0, 229, 255)
EDITED = (255, 255, 0)
_FREE = ("", "table", "box", "elsewhere")  # what may be pulled: not what the hand holds, nor what falls
_LARGER = 1.03  # drawn a little outside of what was perceived


class Truth:
    """Balls and objects of the simulated world."""

    def __init__(
        self, scene: viser.SceneApi, root: str, radius: float, dragged: Callable[[str, float, float], None]
    ) -> None:
        """Start without any.

        Args:
            scene: to which nodes are added.
            root: name of the node under which they are put.
            radius: of a ball [m].
            dragged: called with the id of what was dropped somewhere, and x, y [m].
        """
        self._scene = scene
        self._root = root
        self._radius = radius
        self._dragged = dragged
        self._numbers = count()
        self._editing = False
        self._nodes: dict[str, tuple[Any, Any]] = {}  # by id: what it looks like, its node
        self._free: dict[str, bool] = {}
        self._drags: dict[str, Drag] = {}

    def balls(self, m: PoseArray) -> None:
        """Show these balls and no others."""
        labels = dict(zip(m.ids, m.labels, strict=True)) if m.labels else {}
        places = {name: position_of(pose) for name, pose in zip(m.ids, m.poses, strict=False)}
        self._keep([name for name, (look, _) in self._nodes.items() if look != "ball" or name in places])
        for name, place in places.items():
            if name not in self._nodes:
                node = self._scene.add_icosphere(
                    f"{self._root}/{next(self._numbers)}", _LARGER * self._radius, self._color, subdivisions=2,
                    wireframe=True, position=place, cast_shadow=False, receive_shadow=False,
                )
                self._nodes[name] = ("ball", node)
            self._free[name] = labels.get(name, "") in _FREE
            if not (name in self._drags and self._drags[name].held):
                self._nodes[name][1].position = place
        self._listen()

    def objects(self, m: WorldObjects) -> None:
        """Show these objects and no others."""
        things = {thing.id: thing for thing in m.objects}
        looks = {name: _look(thing) for name, thing in things.items()}
        self._keep([name for name, (look, _) in self._nodes.items() if look == "ball" or looks.get(name) == look])
        for name, thing in things.items():
            if name not in self._nodes:
                node = add_world_object(self._scene, f"{self._root}/{next(self._numbers)}", thing, self._color)
                self._nodes[name] = (looks[name], node)
                self._free[name] = True
            if not (name in self._drags and self._drags[name].held):
                self._nodes[name][1].position = centre_of(thing)
        self._listen()

    def set_editing(self, on: bool) -> None:
        """Let things be pulled about, or not."""
        self._editing = on
        for _, node in self._nodes.values():
            node.color = self._color
        self._listen()

    def node(self, name: str) -> Any:
        """The node of a ball or object by its id; None when there is none."""
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
                self._drags[name] = Drag(node, lambda x, y, name=name: self._dragged(name, x, y))  # type: ignore[misc]
            elif not wanted and name in self._drags:
                self._drags.pop(name).stop()


def _look(thing: WorldObject) -> str:
    """What tells an object from others, wherever it stands."""
    x, y, _ = centre_of(thing)

    def about(edge: list[tuple[float, float]]) -> list[tuple[float, float]]:
        return [(round(a - x, 6), round(b - y, 6)) for a, b in edge]

    return thing.model_copy(update={"outline": about(thing.outline), "hole": about(thing.hole)}).model_dump_json()
