"""A scene without a browser: what was sent is counted, time stands still until told, messages are short to write."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import viser
from numpy.typing import NDArray

from common import messages as m
from common import topics
from common.application import find_application
from common.config import Cell, Surroundings, load_cell
from common.robot.model import RobotModel
from common.robot.transforms import quaternion_to_matrix
from common.robot.visual_meshes import Piece, coarse, visual_pieces
from common.topics import Topic
from page.layers import find_layers
from page.scene import Scene

WORLD = m.Header(stamp=1, frame_id="world")
RED = m.Color(r=1.0, g=0.1, b=0.1)


@cache
def cell_of(name: str) -> Cell:
    return load_cell(name)


@cache
def robot_of(name: str) -> RobotModel:
    return RobotModel.load(cell_of(name).robot)


@cache
def pieces_of(name: str) -> list[Piece]:
    return visual_pieces(robot_of(name))


@cache
def rough_of(name: str) -> list[Piece]:
    return coarse(pieces_of(name), 0.1)


def around_of(name: str) -> Surroundings:
    section = cell_of(name).section(Surroundings)
    assert isinstance(section, Surroundings)
    return section


class Clock:
    """Says the time that it is told [s]."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class ConsoleDouble:
    """Does at once what would be brought to the cell, and keeps it."""

    def __init__(self) -> None:
        self.moved: list[tuple[str, float, float]] = []
        self.put_acts: list[Any] = []

    def put(self, act: Any) -> None:
        self.put_acts.append(act)
        if (doing := act()) is not None:
            asyncio.run(doing)

    def picked(self, name: str) -> None:
        self.chosen = name

    def move(self, name: str, x: float, y: float) -> None:
        self.moved.append((name, round(x, 6), round(y, 6)))


class Stage:
    """The scene of a cell on a server of its own, watched or not: `say` is what the cell says."""

    def __init__(
        self, server: viser.ViserServer, cell: str, own: Sequence[str] = (), keys: Any = (), **options: Any
    ) -> None:
        self.server = server
        self.robot = robot_of(cell)
        self.clock = Clock()
        self.watched = True
        self.console: Any = ConsoleDouble()
        self.said: dict[str, m.Message] = {}
        server.scene.reset()
        few = {  # reading meshes takes a second; here few triangles do
            "visual_pieces": lambda _robot: rough_of(cell), "coarse": lambda pieces, _kept: pieces,
        }
        layers = find_layers(find_application(cell_of(cell).application), own, keys)
        with patch.multiple("page.scene", **few):
            self.view = Scene(
                server, self.robot, around_of(cell), layers, self.console, lambda topic: self.said.get(topic.key),
                clock=self.clock, **options,
            )

    def layer(self, name: str) -> Any:
        return self.view.layers[name]

    def say(self, topic: Topic[Any], message: Any, wait: float = 1.0) -> None:
        """Have the cell say something after a while [s]; it is shown if somebody looks."""
        self.clock.now += wait
        if topic.kind == "event":
            self.view.happened(topic, message)
            return
        self.said[topic.key] = message
        self.look()

    def show(self, layer: str, on: bool) -> None:
        """Show or hide a layer."""
        self.view.set_shown(layer, on)
        self.look()

    def edit(self, on: bool) -> None:
        """Let the simulated world be edited, or not."""
        self.view.set_editing(on)
        self.look()

    def look(self) -> None:
        """Let what is due be shown."""
        if self.watched:
            self.view.refresh(self.clock.now)

    def joints(self, q: Any, others: dict[str, float] | None = None) -> None:
        """Have the robot say where its joints are."""
        self.say(topics.JOINT_STATES, self.joint_state(q, others), 0.0)

    def joint_state(self, q: Any, others: dict[str, float] | None = None) -> m.JointState:
        names = [*self.robot.joint_names, *(others or {})]
        return m.JointState(header=WORLD, name=names, position=[*map(float, q), *(others or {}).values()])

    @contextmanager
    def sent(self) -> Iterator[list[Any]]:
        """Everything that is sent to browsers meanwhile."""
        scene: Any = self.server.scene
        original, found = scene._queue_scene_message, []

        def note(message: Any) -> None:
            found.append(message)
            original(message)

        scene._queue_scene_message = note
        try:
            yield found
        finally:
            scene._queue_scene_message = original


def at(x: float, y: float, z: float) -> m.Pose:
    return m.Pose(position=m.Vector3(x=x, y=y, z=z))


def ball(name: str, pose: m.Pose, role: Any = "target") -> m.CollisionObject:
    return m.CollisionObject(id=name, role=role, shape="sphere", dimensions=[0.03], pose=pose, color=RED)


def scene_of(*objects: m.CollisionObject, held: dict[str, m.CollisionObject] | None = None) -> m.PlanningScene:
    attached = [m.AttachedObject(link=link, object=thing) for link, thing in (held or {}).items()]
    return m.PlanningScene(header=WORLD, objects=list(objects), attached=attached)


def in_world(server: viser.ViserServer, node: Any) -> NDArray[np.float64]:
    """(4, 4) pose of a node, through all nodes above it."""
    T = np.eye(4)
    parts = node.name.split("/")[1:]
    for depth in range(1, len(parts) + 1):
        handle = server.scene.get_handle_by_name("/" + "/".join(parts[:depth]))
        if handle is not None:
            w, x, y, z = (float(value) for value in handle.wxyz)
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = quaternion_to_matrix(x, y, z, w), handle.position
            T = T @ step
    return T


def is_shown(server: viser.ViserServer, node: Any) -> bool:
    """Whether a node and all those above it are visible."""
    parts = node.name.split("/")[1:]
    above = (server.scene.get_handle_by_name("/" + "/".join(parts[:i])) for i in range(1, len(parts) + 1))
    return all(handle is None or handle.visible for handle in above)
