"""The planning scene: fixtures, perceived objects, and what the hand holds."""

from __future__ import annotations

from itertools import count
from typing import Any

import viser

from common.messages import CollisionObject, PlanningScene
from common.viewer.link_poses import LinkPoses
from common.viewer.poses import position_of, wxyz_of
from common.viewer.solids import Solid, add_solid

_FIXED = ("fixture", "container")


class SceneObjects:
    """Nodes of the objects of the newest planning scene. What has not changed is not sent again."""

    def __init__(self, scene: viser.SceneApi, fixtures: str, objects: str, poses: LinkPoses) -> None:
        """Start empty.

        Args:
            scene: to which nodes are added.
            fixtures, objects: names of the nodes under which they are put.
            poses: where the links are that things are attached to.
        """
        self._scene = scene
        self._roots = {True: fixtures, False: objects}
        self._poses = poses
        self._numbers = count()
        self._nodes: dict[tuple[str, str], tuple[Any, Solid]] = {}  # by link and id: what it looks like, its node
        self._links: dict[str, viser.FrameHandle] = {}  # nodes of links that hold something

    def show(self, scene: PlanningScene) -> None:
        """Show these objects and no others; those attached to links that the robot lacks are left out."""
        wanted = {("", each.id): each for each in scene.objects}
        wanted |= {(a.link, a.object.id): a.object for a in scene.attached if self._poses.knows(a.link)}
        for key in [key for key in self._nodes if key not in wanted]:
            self._nodes.pop(key)[1].remove()
        for (link, name), thing in wanted.items():
            self._show(link, name, thing)
        for link in [link for link in self._links if not any(link == on for on, _ in wanted)]:
            self._links.pop(link).remove()
        self.follow()

    def follow(self) -> None:
        """Move what is attached with the links."""
        for link, node in self._links.items():
            node.position, node.wxyz = self._poses.pose(link)

    def node(self, name: str, link: str = "") -> Solid | None:
        """The node of an object by its id, and the link that it is attached to."""
        found = self._nodes.get((link, name))
        return found[1] if found else None

    def _show(self, link: str, name: str, thing: CollisionObject) -> None:
        look = (thing.shape, thing.dimensions, thing.outline, thing.color, thing.role in _FIXED)
        known = self._nodes.get((link, name))
        if known is not None and known[0] == look:
            known[1].position, known[1].wxyz = position_of(thing.pose), wxyz_of(thing.pose)
            return
        if known is not None:
            known[1].remove()
        node = add_solid(self._scene, f"{self._root(link, thing)}/{next(self._numbers)}", thing)
        self._nodes[link, name] = (look, node)

    def _root(self, link: str, thing: CollisionObject) -> str:
        if not link:
            return self._roots[thing.role in _FIXED]
        root = f"{self._roots[False]}/held_by_{link}"
        if link not in self._links:
            self._links[link] = self._scene.add_frame(root, show_axes=False)
        return root
