"""The planning scene: fixtures, perceived objects, and what the hand holds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import Any, ClassVar

import viser

from common import topics
from common.messages import CollisionObject
from common.topics import Topic
from page.layers import Layer
from page.nodes import Solid, add_solid, position_of, wxyz_of

FIXED = ("fixture", "container")


class Fixtures(Layer):
    """What never moves. What has not changed is not sent again."""

    LABEL = "Fixtures"
    TOPICS: ClassVar[Sequence[Topic[Any]]] = (topics.PLANNING_SCENE,)
    MOVABLE: ClassVar[bool] = False

    def build(self) -> None:
        """Start empty."""
        self._numbers = count()
        self._nodes: dict[tuple[str, str], tuple[Any, Solid]] = {}  # by link and id: what it looks like, its node
        self._links: dict[str, viser.FrameHandle] = {}  # nodes of links that hold something

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these objects and no others; those attached to links that the robot lacks are left out."""
        wanted = {("", each.id): each for each in message.objects if (each.role in FIXED) is not self.MOVABLE}
        if self.MOVABLE:
            wanted |= {(a.link, a.object.id): a.object for a in message.attached if self.stage.poses.knows(a.link)}
        for key in [key for key in self._nodes if key not in wanted]:
            self._nodes.pop(key)[1].remove()
        for (link, name), thing in wanted.items():
            self._show(link, name, thing)
        for link in [link for link in self._links if not any(link == on for on, _ in wanted)]:
            self._links.pop(link).remove()
        self._follow()

    def node(self, name: str, link: str = "") -> Solid | None:
        """The node of an object by its id, and the link that it is attached to."""
        found = self._nodes.get((link, name))
        return found[1] if found else None

    def _follow(self) -> None:
        """Move what is attached with the links."""
        for link, node in self._links.items():
            node.position, node.wxyz = self.stage.poses.pose(link)

    def _show(self, link: str, name: str, thing: CollisionObject) -> None:
        look = (thing.shape, thing.dimensions, thing.outline, thing.color)
        known = self._nodes.get((link, name))
        if known is not None and known[0] == look:
            known[1].position, known[1].wxyz = position_of(thing.pose), wxyz_of(thing.pose)
            return
        if known is not None:
            self._nodes.pop((link, name))[1].remove()
        node = add_solid(self.scene, f"{self._above(link)}/{next(self._numbers)}", thing)
        if node is not None:
            self._nodes[link, name] = (look, node)

    def _above(self, link: str) -> str:
        if not link:
            return self.root
        root = f"{self.root}/held_by_{link}"
        if link not in self._links:
            self._links[link] = self.scene.add_frame(root, show_axes=False)
        return root


class Objects(Fixtures):
    """What was perceived, and what the hand holds."""

    LABEL = "Perceived objects"
    TOPICS = (topics.PLANNING_SCENE, topics.JOINT_STATES)
    MOVABLE = True

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show these objects and no others, or have what is held follow the hand."""
        if topic == topics.JOINT_STATES:
            self._follow()
        else:
            super().show(topic, message)
