"""The 3D scene of the page: everything that a cell publishes about space, layer by layer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import viser
from numpy.typing import NDArray

from common.config import Surroundings
from common.messages import (
    CameraInfo,
    Contours,
    JointState,
    JointTrajectory,
    MarkerArray,
    OutlinePoints,
    PlanningScene,
    Pose,
    PoseArray,
    Rejections,
    TFMessage,
    WorldObjects,
)
from common.robot.model import RobotModel
from common.viewer.layers import LAYERS, layers_shown

Picture = NDArray[np.uint8]  # (height, width, 3) RGB


class SceneView:
    """Shows messages in the scene of a viser server.

    Poses are in world. Called from one thread; what the person does arrives as plain calls from viser's threads.
    Messages that can not be shown, such as poses of unknown links, are left out.

    Attributes:
        layers: names of what can be shown and hidden, with their labels in `LAYERS`.
        on_select: called with the index of the contour that was clicked.
        on_object_dragged: called with the id of an object of the simulated world and where it was dropped, x, y [m].
        on_goal_moved: called with the pose of the goal marker when it was let go.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: RobotModel,
        around: Surroundings,
        *,
        visible: Mapping[str, bool] | None = None,
    ) -> None:
        """Put the robot and the camera's view of the cell into the scene.

        Args:
            server: whose scene is filled.
            robot: not used by another thread.
            around: the camera and the table.
            visible: layers that are shown, or not, other than `LAYERS` says.

        Raises:
            UnknownName: a layer in `visible` does not exist.
            ConfigError: a mesh of the robot can not be read.
        """
        self.layers = list(LAYERS)
        self.on_select: Callable[[int], None] = lambda _index: None
        self.on_object_dragged: Callable[[str, float, float], None] = lambda _id, _x, _y: None
        self.on_goal_moved: Callable[[Pose], None] = lambda _pose: None
        self._server = server
        self._robot = robot
        self._around = around
        self._shown = layers_shown(visible or {})

    def visible(self, layer: str) -> bool:
        """Whether a layer is shown."""
        return self._shown[layer]

    def set_visible(self, layer: str, on: bool) -> None:
        """Show or hide a layer.

        Raises:
            UnknownName: there is no such layer.
        """
        self._shown.update(layers_shown({**self._shown, layer: on}))

    def show_joints(self, m: JointState) -> None:
        """Move the robot, and a ghost that is playing a plan; call it at most 30 times a second."""

    def show_scene(self, m: PlanningScene) -> None:
        """Show fixtures and perceived objects; an attached one moves with its link."""

    def show_targets(self, m: PoseArray) -> None:
        """Show where the arm may take something."""

    def show_rejected(self, m: Rejections) -> None:
        """Show, with the reason, what it can not take; adds to what was shown until `clear_rejected`."""

    def clear_rejected(self) -> None:
        """Forget what was rejected: a task began anew."""

    def show_workspace(self, m: MarkerArray) -> None:
        """Show the reachable shell and the excluded column."""

    def show_transforms(self, m: TFMessage) -> None:
        """Show frames, of tf or tf_static, and put the camera where its frame is."""

    def show_camera(self, m: CameraInfo) -> None:
        """Show what the camera sees as a frustum."""

    def show_picture(self, rgb: Picture) -> None:
        """Show a picture in the camera's frustum; a few a second are enough."""

    def show_plan(self, m: JointTrajectory) -> None:
        """Show the end of a trajectory as a ghost of the robot, and the path of the tool as a line."""

    def play_plan(self) -> None:
        """Let the ghost move along the newest plan, over and over, until the next plan or until the robot moves."""

    def show_outline(self, m: OutlinePoints) -> None:
        """Show the outline of the chosen object as a line."""

    def show_contours(self, m: Contours) -> None:
        """Show what may be chosen as lines, each with its label; clicking one calls `on_select`."""

    def show_truth(self, balls: PoseArray | None = None, objects: WorldObjects | None = None) -> None:
        """Show where everything really is, beside what was perceived; what is None stays as it was."""

    def set_editing(self, on: bool) -> None:
        """Let objects of the simulated world be dragged on the table; they are shown meanwhile."""

    def goal_marker(self, on: bool) -> None:
        """Show or hide the marker that tells a goal for the tool centre point; it appears where the tool is."""

    @property
    def goal_pose(self) -> Pose:
        """Pose of the goal marker."""
        return Pose()

    @goal_pose.setter
    def goal_pose(self, pose: Pose) -> None:
        """Put the goal marker somewhere."""
