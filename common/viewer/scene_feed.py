"""Brings what the cell says into the 3D scene, once there is one, and knows what of it a person wants to see."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from common import topics
from common.applications.outlining.messages import Contours
from common.applications.outlining.topics import CONTOUR_PATH, CONTOURS
from common.applications.pick_place.topics import DETECTED_OBJECTS, VALIDATED_TARGETS, WORKSPACE_MARKERS
from common.messages import JointState, JointTrajectory, Rejections
from common.topics import Topic
from common.viewer.feeds import Feeds
from common.viewer.layers import layers_shown
from common.viewer.periods import Periods
from common.viewer.pictures import Picture

if TYPE_CHECKING:
    from common.viewer.scene_view import SceneView


class SceneFeed:
    """Feeds a scene.

    Attributes:
        scene: None until its meshes are read.
        layers: whether each is shown.
        editing: whether objects of the simulated world can be dragged.
    """

    def __init__(self, feeds: Feeds, periods: Periods, layers: Mapping[str, bool], editing: bool) -> None:
        """Start without a scene.

        Args:
            feeds: what the cell says.
            periods: of the parts.
            layers: that are shown, or not, other than usual.
            editing: whether objects can be dragged at first.

        Raises:
            UnknownName: there is no such layer.
        """
        self._feeds, self._periods = feeds, periods
        self.scene: SceneView | None = None
        self.layers = layers_shown(layers)
        self.editing = editing
        self._played = -1  # stamp of the plan that a person asked for
        self._rejected: list[Rejections] = []  # before there is a scene: each is said only once

    def begin(self, scene: SceneView) -> None:
        """Feed a scene from now on."""
        self.scene = scene
        for name, on in self.layers.items():
            scene.set_visible(name, on)
        if self.editing:
            scene.set_editing(True)
        for rejections in self._rejected:
            scene.show_rejected(rejections)
        self._rejected.clear()

    def wanted(self) -> list[Topic[Any]]:
        """Topics, of those that are read on demand, that the scene needs to be seen."""
        wanted: list[Topic[Any]] = [CONTOURS]
        if self.layers["truth"] or self.editing:
            wanted.append(topics.SCENE_OBJECTS)
        if self.layers["frames"]:
            wanted.append(topics.TF)
        if self.layers["rejected"]:
            wanted.append(DETECTED_OBJECTS)
        return wanted

    def set_layer(self, name: str, on: bool) -> None:
        """Show or hide a layer."""
        self.layers[name] = on
        if self.scene is not None:
            self.scene.set_visible(name, on)

    def set_editing(self, on: bool) -> None:
        """Let objects of the simulated world be dragged, or not."""
        self.editing = on
        if self.scene is not None:
            self.scene.set_editing(on)

    def reject(self, rejections: Rejections) -> None:
        """Show what is new among the rejected."""
        if self.scene is not None:
            self.scene.show_rejected(rejections)
        else:
            self._rejected.append(rejections)

    def play(self, plan: JointTrajectory) -> None:
        """Let the ghost of the robot move along a plan."""
        if self.scene is not None:
            self._played = plan.header.stamp
            self.scene.show_plan(plan)
            self.scene.play_plan()

    def _plan(self, plan: JointTrajectory) -> None:
        if self.scene is not None and plan.header.stamp != self._played:  # else it is on show and would begin anew
            self.scene.show_plan(plan)

    def picture(self, rgb: Picture, now: float) -> None:
        """Show what the camera sees in its frustum, at a wall time [s]; a few of them are enough."""
        if self.scene is not None and self.layers["camera"] and self._periods.due("frustum", now):
            self.scene.show_picture(rgb)

    def show(self, joints: JointState | None, contours: Contours | None, now: float) -> None:
        """Show what is new at a wall time [s].

        Args:
            joints: where the robot is, when that is new.
            contours: that may be chosen, when they are new.
            now: wall time.
        """
        scene = self.scene
        if scene is None:
            return
        if joints is not None:
            scene.show_joints(joints)
        if contours is not None:
            scene.show_contours(contours)
        shows: list[tuple[Topic[Any], Callable[[Any], None]]] = [
            (topics.PLANNING_SCENE, scene.show_scene), (VALIDATED_TARGETS, scene.show_targets),
            (WORKSPACE_MARKERS, scene.show_workspace), (topics.TF_STATIC, scene.show_transforms),
            (topics.TF, scene.show_transforms), (topics.CAMERA_INFO, scene.show_camera),
            (topics.DEPTH_CAMERA_INFO, scene.show_camera), (topics.DISPLAY_TRAJECTORY, self._plan),
            (CONTOUR_PATH, scene.show_outline),
        ]
        if self._periods.due("detected", now):
            shows.append((DETECTED_OBJECTS, scene.show_detected))
        for topic, show in shows:
            if (message := self._feeds.fresh(topic)) is not None:
                show(message)
        if (objects := self._feeds.fresh(topics.SCENE_OBJECTS)) is not None:
            scene.show_truth(objects)
