"""Outlining on the operator's page: objects to select, as buttons and in the scene, and the outline."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from applications.outlining.contour_choice import middle_of
from applications.outlining.topics import (
    CONTOUR_PATH,
    CONTOURS,
    OUTLINE_SELECT,
    OUTLINE_STATUS,
    Contour,
    OutlineSelect,
    OutlineSelection,
    OutlineStatus,
)
from common import topics
from common.config import Fixture
from common.messages import CollisionObject, MotionStatus, TaskStatus
from common.perception.pinhole import CameraError, Pinhole
from common.topics import Topic
from page.application import ApplicationPage
from page.layers import Layer
from page.nodes import FLAT, Labels, add_line, points_of, rgb_of

if TYPE_CHECKING:
    import viser

    from page.console import Console

Array = NDArray[np.float64]

LARGEST = "Largest"
OUTLINE = (255, 140, 40)
CHOSEN = (255, 255, 255)
_ENDED = ("IDLE", "DONE", "ERROR")
_PATH_TIMEOUT = 5.0  # [s] wall time from the selection of an object until its path is known
_LIFTED = 0.002  # [m] height of lines above the faces, to stay visible
_POINTS = 200  # of a contour
_MOST = 100  # largest contours that are drawn; drawing noise would block the page and its STOP button
_PIN = 0.006  # radius of a clickable pin [m]

_newest: WeakKeyDictionary[Console, OutlineSelection] = WeakKeyDictionary()  # last selection of each page


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """Figures of the task by label."""
    if not isinstance(status, OutlineStatus):
        return {}
    return {"points": status.points, "outline [mm]": f"{1e3 * status.length_m:.0f}",
            "planned": f"{100 * status.fraction:.0f} %", "failures": status.failures}


def progress(status: TaskStatus, motion: MotionStatus | None) -> float:
    """Progress of the running motion."""
    return motion.progress if motion is not None and motion.state == "active" else 0.0


def choice_of(contour: Contour) -> OutlineSelect:
    """Return a selection by position, independent of the numbering in later images."""
    return OutlineSelect(rule="index", index=contour.index, at=middle_of(contour))


async def choose(console: Console, choice: OutlineSelect) -> None:
    """Select an object and start the task once its path is known; report which object it is.

    A stop or hold in the meantime prevents the start; of several selections the last one counts.
    """
    console.notify("")
    acknowledged, stops = console.acknowledged, console.stop_count
    chosen = _newest[console] = await console.call(OUTLINE_SELECT, choice)
    status = console.latest(OUTLINE_STATUS)
    if status is not None and (not status.started or status.state in _ENDED):  # else it starts by itself
        try:
            async with asyncio.timeout(_PATH_TIMEOUT):
                while (path := console.latest(CONTOUR_PATH)) is None or path.object != chosen.label:  # noqa: ASYNC110
                    await asyncio.sleep(0.02)  # other tasks read the messages
        except TimeoutError:
            pass  # the task reports what is wrong with the object
        if _newest[console] is not chosen:  # the newer selection starts the task
            return
        if console.stop_count > stops or (console.acknowledged or 0) > (acknowledged or 0):
            console.notify(f"{chosen.label} is chosen, but not traced: the arm was stopped or held meanwhile", "busy")
            return
        await console.command("start", acknowledged=acknowledged)
    console.notify(f"{chosen.label} is chosen", "good")


class Controls:
    """A button for each object of the image; the selected one is marked."""

    TOPICS = (CONTOURS,)
    PERIOD = 0.5  # [s]

    def __init__(self, gui: viser.GuiApi, console: Console) -> None:
        """Create the buttons at the current position in the GUI."""
        self._console = console
        self._offered: dict[str, Contour] = {}
        self._buttons = gui.add_button_group("Outline", (LARGEST,), hint="choose an object: it is traced")
        console.on_choice(self._buttons, self._choose)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Update the buttons to the objects of an image."""
        self._offered = {contour.label: contour for contour in message.contours}
        marked = (f"{'● ' if c.index == message.selected else ''}{c.label}" for c in message.contours)
        options = (*marked, LARGEST)
        if options != self._buttons.options:
            self._buttons.options = options

    async def _choose(self, chosen: str) -> None:
        contour = self._offered.get(chosen.removeprefix("● "))
        await choose(self._console, choice_of(contour) if contour is not None else OutlineSelect(rule="auto"))


class Outline(Layer):
    """The outline of the selected object as a closed line."""

    LABEL = "Outline"
    LEGEND = (("outline that is traced", OUTLINE),)
    TOPICS = (CONTOUR_PATH,)

    def build(self) -> None:
        """Start without an outline."""
        self.node: viser.LineSegmentsHandle | None = None
        self._points: Array = np.empty((0, 3))

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show this outline; one without points clears it."""
        points = points_of(message.poses)
        if np.array_equal(points, self._points):
            return
        self._points = points
        if self.node is not None:
            self.node.remove()
            self.node = None
        if len(points) > 1:
            above = points + np.array([0.0, 0.0, 2 * _LIFTED])  # above the line of its contour
            self.node = add_line(self.scene, f"{self.root}/line", above, OUTLINE, 4.0, closed=True)


class ContourChoice(Layer):
    """The contours of the image on the objects, each with a clickable pin and its label."""

    NAME = "contours"
    LABEL = "Contours to choose from"
    LEGEND = (("contour that is chosen", CHOSEN),)
    TOPICS = (CONTOURS, topics.DEPTH_CAMERA_INFO, topics.PLANNING_SCENE, topics.TF_STATIC)
    PERIOD = 0.5

    def build(self) -> None:
        """Start without contours."""
        self._shown: object = None
        self.nodes: list[viser.LineSegmentsHandle | viser.IcosphereHandle] = []
        self.labels = Labels(self.scene, self.root, scale=0.8)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Show the newest contours on the objects with their labels, as their camera sees them."""
        m, info = self.stage.latest(CONTOURS), self.stage.latest(topics.DEPTH_CAMERA_INFO)
        if m is None or info is None:
            return
        try:
            camera = Pinhole.from_info(info, self.stage.transforms.pose(info.header.frame_id))
        except CameraError:  # distorted camera: its pixels do not fit the pinhole model
            return
        scene = self.stage.latest(topics.PLANNING_SCENE)
        tops = {thing.id: _top(thing) for thing in scene.objects} if scene else {}
        largest = sorted(m.contours, key=lambda c: (c.index != m.selected, -c.area))[:_MOST]
        heights = [tops.get(c.label) or self._support(c, camera) for c in largest]
        what = (largest, m.selected, m.width, heights, camera.T_world_optical.tolist(), camera.fx, camera.cx)
        if what == self._shown:
            return
        self._shown = what
        for node in self.nodes:
            node.remove()
        self.nodes = []
        labels = {}
        for contour, height in zip(largest, heights, strict=True):
            at = self._add(contour, height + _LIFTED, camera, chosen=contour.index == m.selected)
            if at is not None:
                labels[str(contour.index)] = f"{contour.index}: {contour.label}", at
        self.labels.show(labels, self.stage.projection())

    def _add(self, contour: Contour, height: float, camera: Pinhole, *, chosen: bool) -> Array | None:
        """Add the contour and its pin; return the position of its label."""
        pixels = np.array(contour.pixels)
        some = pixels[np.unique(np.linspace(0, len(pixels) - 1, _POINTS).round().astype(int))]
        at = camera.on_plane(some, height)
        points = np.column_stack([at, np.full(len(at), height)])
        if not np.isfinite(points).all():  # the camera does not look down at it
            return None
        name, color = f"{self.root}/{contour.index}", CHOSEN if chosen else rgb_of(contour.color)
        line = add_line(self.scene, f"{name}_line", points, color, 2.0, closed=True)
        x, y = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
        pin = self.scene.add_icosphere(f"{name}_pin", _PIN, color, position=(x, y, height + 2 * _PIN), **FLAT)
        console, choice = self.stage.console, choice_of(contour)

        @pin.on_click
        async def _(_event: object) -> None:
            console.put(lambda: choose(console, choice))

        self.nodes += [line, pin]
        return np.array([x, y, height + 4 * _PIN])

    def _support(self, contour: Contour, camera: Pinhole) -> float:
        """Height [m] of the highest flat fixture below the contour, else of the table."""
        middle = np.array(contour.pixels).mean(axis=0)
        fixtures = self.stage.around.fixtures
        for height, fixture in sorted(((fixture_top(f), f) for f in fixtures), key=lambda pair: -pair[0]):
            x, y = camera.on_plane(middle, height)
            if _carries(fixture, float(x), float(y)):
                return height
        return self.stage.around.table_height


def fixture_top(fixture: Fixture) -> float:
    """Height [m] of the top of an upright fixture."""
    sizes = fixture.dimensions
    half = {"box": sizes[-1] / 2, "cylinder": sizes[-1] / 2, "sphere": sizes[0]}[fixture.shape]
    return fixture.position[2] + half


def _carries(fixture: Fixture, x: float, y: float) -> bool:
    if fixture.shape == "sphere" or any(fixture.rpy[:2]):
        return False
    dx, dy = x - fixture.position[0], y - fixture.position[1]
    if fixture.shape == "cylinder":
        return bool(np.hypot(dx, dy) <= fixture.dimensions[0])
    c, s = np.cos(fixture.rpy[2]), np.sin(fixture.rpy[2])
    return bool(abs(c * dx + s * dy) <= fixture.dimensions[0] / 2 and abs(c * dy - s * dx) <= fixture.dimensions[1] / 2)


def _top(thing: CollisionObject) -> float:
    """Height [m] of the top of an upright object."""
    sizes = thing.dimensions
    return thing.pose.position.z + (sizes[0] if thing.shape == "sphere" else sizes[-1] / 2)


PAGE = ApplicationPage(
    layers=(Outline, ContourChoice), controls=Controls, requests=(OUTLINE_SELECT,),
    states={"SELECTING": "Waiting for a choice", "PLANNING": "Planning", "APPROACHING": "Approaching",
            "TRACING": "Tracing", "RETREATING": "Retreating"},
    latency="Image to path", counters=counters, progress=progress,
)
