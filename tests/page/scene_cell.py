"""A scene without a browser: sent messages are recorded, time is set by the test, messages are short to write."""

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
from common.robot.transforms import quaternion_to_matrix, transform
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
    return cell_of(name).section(Surroundings)


class Clock:
    """Returns the time that the test sets [s]."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


class FakeConsole:
    """Runs actions at once, and records moved and selected objects."""

    def __init__(self) -> None:
        self.moved: list[tuple[str, float, float]] = []
        self.selected = ""

    def put(self, action: Any) -> None:
        if (coroutine := action()) is not None:
            asyncio.run(coroutine)

    def on_object_selected(self, name: str) -> None:
        self.selected = name

    def on_object_moved(self, name: str, x: float, y: float) -> None:
        self.moved.append((name, round(x, 6), round(y, 6)))


class Stage:
    """The scene of a cell on a server; `say` publishes a message, `watched` is whether a page is open."""

    def __init__(
        self, server: viser.ViserServer, cell: str, custom: Sequence[str] = (), keys: Any = (), **options: Any
    ) -> None:
        self.server = server
        self.robot = robot_of(cell)
        self.clock = Clock()
        self.watched = True
        self.console: Any = FakeConsole()
        self.messages: dict[str, m.Message] = {}
        server.scene.reset()
        few_triangles = {  # reading all meshes would take a second
            "visual_pieces": lambda _robot: rough_of(cell), "coarse": lambda pieces, _share: pieces,
        }
        layers = find_layers(find_application(cell_of(cell).application), custom, keys)
        with patch.multiple("page.scene", **few_triangles):
            self.view = Scene(
                server, self.robot, around_of(cell), layers, self.console, lambda topic: self.messages.get(topic.key),
                clock=self.clock, **options,
            )

    def layer(self, name: str) -> Any:
        return self.view.layers[name]

    def say(self, topic: Topic[Any], message: Any, wait: float = 1.0) -> None:
        """Publish a message after a while [s]; it is displayed if a page is open."""
        self.clock.now += wait
        if topic.kind == "event":
            self.view.handle_event(topic, message)
            return
        self.messages[topic.key] = message
        self.refresh()

    def show(self, layer: str, on: bool) -> None:
        self.view.set_shown(layer, on)
        self.refresh()

    def edit(self, on: bool) -> None:
        self.view.set_editing(on)
        self.refresh()

    def refresh(self) -> None:
        if self.watched:
            self.view.refresh(self.clock.now)

    def joints(self, q: Any, others: dict[str, float] | None = None) -> None:
        """Publish joint states."""
        self.say(topics.JOINT_STATES, self.joint_state(q, others), 0.0)

    def joint_state(self, q: Any, others: dict[str, float] | None = None) -> m.JointState:
        names = [*self.robot.joint_names, *(others or {})]
        return m.JointState(header=WORLD, name=names, position=[*map(float, q), *(others or {}).values()])

    @contextmanager
    def sent(self) -> Iterator[list[Any]]:
        """Record everything that is sent to browsers inside the block."""
        found: list[Any] = []
        queue = self.server.scene._queue_scene_message
        with patch.object(self.server.scene, "_queue_scene_message", lambda each: (found.append(each), queue(each))):
            yield found


def at(x: float, y: float, z: float) -> m.Pose:
    return m.Pose(position=m.Vector3(x=x, y=y, z=z))


def ball(name: str, pose: m.Pose, role: Any = "target") -> m.CollisionObject:
    return m.CollisionObject(id=name, role=role, shape="sphere", dimensions=[0.03], pose=pose, color=RED)


def scene_of(*objects: m.CollisionObject, held: dict[str, m.CollisionObject] | None = None) -> m.PlanningScene:
    attached = [m.AttachedObject(link=link, object=thing) for link, thing in (held or {}).items()]
    return m.PlanningScene(header=WORLD, objects=list(objects), attached=attached)


def parents(server: viser.ViserServer, node: Any) -> list[Any]:
    """Return the handles of all parents of a node and of itself, from the root."""
    parts = node.name.split("/")[1:]
    found = (server.scene.get_handle_by_name("/" + "/".join(parts[:depth + 1])) for depth in range(len(parts)))
    return [handle for handle in found if handle is not None]


def in_world(server: viser.ViserServer, node: Any) -> NDArray[np.float64]:
    """Return the (4, 4) pose of a node, through all its parents."""
    T = np.eye(4)
    for handle in parents(server, node):
        w, x, y, z = (float(value) for value in handle.wxyz)
        T = T @ transform(quaternion_to_matrix(x, y, z, w), handle.position)
    return T


def is_shown(server: viser.ViserServer, node: Any) -> bool:
    """Return whether a node and all its parents are visible."""
    return all(handle.visible for handle in parents(server, node))
