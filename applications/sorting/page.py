"""Sorting on the operator's page: the heap as points, what was recognized, grasps, and what hinders the arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from applications.sorting.fingers import finger_lines
from applications.sorting.topics import HEAP, GraspCandidate, Heap, SeenObject, SortingStatus
from common import topics
from common.messages import TaskStatus
from common.topics import Topic
from page.application import ApplicationPage
from page.layers import Layer
from page.layers.frames import thin_out
from page.nodes import FLAT, Labels, Rgb, add_line, matrix_wxyz, rgb_of
from page.status_text import of_total, throughput

if TYPE_CHECKING:
    import viser

Array = NDArray[np.float64]

TRAY = "tray"
MAX_POINTS = 15_000  # of the heap: a browser without a GPU draws them several times a second
ABOVE, BEYOND = 0.25, 0.02  # [m] over and next to the tray, within which points belong to the heap
MOST = 24  # grasps that are drawn, the best first
GOOD, POOR = np.array([70.0, 220.0, 110.0]), np.array([230.0, 150.0, 40.0])  # color of the scores 1 and 0
FAINT = 0.4  # brightness of a grasp that is not proved
FOREIGN = (235, 50, 50)
LEFT = (255, 90, 200)
WAITS = "not examined"  # begin of the reason of an object that may have grasps
_LIFTED = 0.002  # [m] height of lines above surfaces, to stay visible
_POINT_SIZE = 0.003  # [m]


def counters(status: TaskStatus, rejected: int) -> dict[str, object]:
    """Figures of the task by label."""
    tries = status.attempts if isinstance(status, SortingStatus) else 0
    good = f"{100 * min(status.done / tries, 1.0):.0f} %" if tries else "–"
    held = status.held if isinstance(status, SortingStatus) else ""
    return {"sorted": of_total(status), "tries": tries, "success": good, **throughput(status),
            "last check": held or "–", "failures": status.failures}


class Points(Layer):
    """The heap as the depth camera measures it, in its colors; replaces the point cloud of the complete image."""

    LABEL = "Heap as points"
    TOPICS = (topics.DEPTH_CAMERA_POINTS,)
    PERIOD = 0.5

    def build(self) -> None:
        """Start empty."""
        self.nodes: dict[str, viser.PointCloudHandle] = {}  # by topic key

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Replace the points of a camera by those over the tray."""
        found = thin_out(message, message.width * message.height)
        if found is None:
            return
        points, colors = found
        T = self.stage.transforms.pose(message.header.frame_id)
        near = self._over_tray(points @ T[:3, :3].T + T[:3, 3])
        points, colors = points[near], colors[near]
        stride = max(1, -(-len(points) // MAX_POINTS))
        self.nodes[topic.key] = self.scene.add_point_cloud(
            f"{self.root}/{topic.key.replace('/', '_')}", points[::stride], colors[::stride], point_size=_POINT_SIZE,
            point_shape="square", point_shading="flat", precision="float32", position=T[:3, 3], wxyz=matrix_wxyz(T))

    def _over_tray(self, points: Array) -> NDArray[np.bool_]:
        """Mask of points (n, 3) [m] in world that are in the tray or above it; all of them in a cell without one."""
        around = self.stage.around
        tray = around.containers.get(TRAY)
        if tray is None:
            return np.full(len(points), True)
        outside = np.abs(points[:, :2] - (tray.x, tray.y)).max(axis=1)
        return np.asarray((outside < tray.half_side + BEYOND) & (points[:, 2] < around.table_height + ABOVE))


class Objects(Layer):
    """The outline of each object that was recognized, and its name."""

    LABEL = "Objects"
    LEGEND = (("object without a grasp", LEFT),)
    TOPICS = (HEAP,)
    PERIOD = 0.2

    def build(self) -> None:
        """Start without objects."""
        self.nodes: list[viser.LineSegmentsHandle] = []
        self.labels = Labels(self.scene, self.root, scale=0.5)
        self._shown: object = None

    def show(self, topic: Topic[Any], message: Heap) -> None:
        """Show the objects of the newest image from home, which hides none."""
        if not message.at_home or (message.objects, message.left) == self._shown:
            return
        self._shown = message.objects, message.left
        for node in self.nodes:
            node.remove()
        left = reasons(message)
        self.nodes = [self._add(each, LEFT if each.id in left else rgb_of(each.color))
                      for each in message.objects if len(each.outline) > 2]
        self.labels.show({each.id: (each.id, above(each)) for each in message.objects}, self.stage.projection())

    def _add(self, thing: SeenObject, color: Rgb) -> viser.LineSegmentsHandle:
        outline = np.array(thing.outline)
        points = np.column_stack([outline, np.full(len(outline), thing.top + _LIFTED)])
        return add_line(self.scene, f"{self.root}/{thing.id}", points, color, 3.0, closed=True)


class Left(Layer):
    """Why an object cannot be grasped now."""

    NAME = "left_objects"
    LABEL = "Why objects are left"
    TOPICS = (HEAP,)
    PERIOD = 0.5

    def build(self) -> None:
        """Start without reasons."""
        self.labels = Labels(self.scene, self.root, scale=0.6)

    def show(self, topic: Topic[Any], message: Heap) -> None:
        """Show the reasons of the newest image from home."""
        if not message.at_home:
            return
        left = reasons(message)
        self.labels.show({each.id: (f"{each.id}: {left[each.id]}", above(each))
                          for each in message.objects if each.id in left}, self.stage.projection())


class Grasps(Layer):
    """The best grasps as two fingers and the bar between them, green for a high score; proved ones are bright."""

    LABEL = "Grasps"
    LEGEND = (("grasp, high score", (70, 220, 110)), ("grasp, low score", (230, 150, 40)))
    TOPICS = (HEAP,)
    PERIOD = 0.2

    def build(self) -> None:
        """Start without grasps."""
        self.nodes: dict[bool, viser.LineSegmentsHandle] = {}  # by whether they are proved
        gripper = self.stage.robot.config.gripper
        self._axis = 0 if gripper is not None and gripper.closing_axis == "x" else 1
        self._shown: object = None

    def show(self, topic: Topic[Any], message: Heap) -> None:
        """Show the grasps of the newest image from home."""
        if not message.at_home or message.grasps == self._shown:
            return
        self._shown = message.grasps
        for node in self.nodes.values():
            node.remove()
        self.nodes = {}
        best = message.grasps[:MOST]
        for proved in (False, True):
            some = [grasp for grasp in best if grasp.proved == proved]
            if some:
                segments = np.concatenate([finger_lines(grasp, self._axis) for grasp in some])
                colors = np.repeat([score_color(grasp) for grasp in some], len(segments) // len(some), axis=0)
                self.nodes[proved] = self.scene.add_line_segments(
                    f"{self.root}/{'proved' if proved else 'others'}", segments,
                    np.repeat(colors[:, None], 2, axis=1), thickness=4.0 if proved else 1.5, thickness_units="screen")


class ForeignBodies(Layer):
    """Boxes around what belongs to no object, such as a hand: the arm does not move into them."""

    LABEL = "Foreign bodies"
    LEGEND = (("foreign body", FOREIGN),)
    TOPICS = (HEAP,)
    PERIOD = 0.2

    def build(self) -> None:
        """Start without boxes."""
        self.nodes: list[viser.BoxHandle] = []
        self._shown: object = []

    def show(self, topic: Topic[Any], message: Heap) -> None:
        """Show these boxes only; away from home they are reported as well."""
        if message.foreign == self._shown:
            return
        self._shown = message.foreign
        for node in self.nodes:
            node.remove()
        self.nodes = [self.scene.add_box(
            f"{self.root}/{number}", FOREIGN, (each.size.x, each.size.y, each.size.z), opacity=0.45,
            flat_shading=False, position=(each.center.x, each.center.y, each.center.z), **FLAT)
            for number, each in enumerate(message.foreign)]


def score_color(grasp: GraspCandidate) -> NDArray[np.uint8]:
    """Return red, green and blue (3,) of a grasp."""
    share = min(max(grasp.score, 0.0), 1.0)
    color = share * GOOD + (1 - share) * POOR
    return np.asarray(color if grasp.proved else FAINT * color).round().astype(np.uint8)


def reasons(heap: Heap) -> dict[str, str]:
    """Return why objects have no grasp, by id; without those that only wait for better grasps of others."""
    return {each.object: each.reason for each in heap.left if not each.reason.startswith(WAITS)}


def above(thing: SeenObject) -> Array:
    """Return the position (3,) [m] of the label of an object."""
    return np.array([thing.center.x, thing.center.y, thing.top + _LIFTED])


PAGE = ApplicationPage(
    layers=(Points, Objects, Left, Grasps, ForeignBodies),
    states={"GRASPING": "Grasping", "CHECKING": "Checking", "PLACING": "Placing", "STIRRING": "Stirring"},
    latency="Image to grasps", counters=counters,
)
