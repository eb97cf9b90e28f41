"""The 3D scene of the page: everything that a cell publishes about space, layer by layer."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from common.applications.outlining.messages import Contours, OutlinePoints
from common.config import Surroundings
from common.messages import (
    CameraInfo,
    JointState,
    JointTrajectory,
    MarkerArray,
    PlanningScene,
    Pose,
    PoseArray,
    Rejections,
    TFMessage,
    WorldObjects,
)
from common.perception.pinhole import CameraError, Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.viewer.camera import Camera, Picture
from common.viewer.camera_pose import Transforms
from common.viewer.figure import Figure
from common.viewer.frames import Frames
from common.viewer.goal import GoalMarker
from common.viewer.layers import LAYERS, layers_shown
from common.viewer.link_poses import LinkPoses
from common.viewer.markers import Rejected, Targets, Workspace
from common.viewer.outline import ContourChoice, Outline
from common.viewer.plan import Plan
from common.viewer.robot_meshes import coarse, visual_pieces
from common.viewer.scene_objects import SceneObjects
from common.viewer.truth import Truth

_GHOST = 0.3  # share of the robot's triangles that its ghost has
_TF_PERIOD = 0.1  # [s] frames are moved so often

# Which layers a message is for: while none of them is shown, it waits.
_LAYERS_OF = {
    "joints": ("robot", "objects", "plan"),
    "scene": ("fixtures", "objects"),
    "targets": ("targets",),
    "workspace": ("workspace",),
    "transforms": ("frames", "camera", "contours"),
    "camera": ("camera", "contours"),
    "picture": ("camera",),
    "plan": ("plan", "tool_path"),
    "outline": ("outline",),
    "contours": ("contours",),
    "world": ("truth",),
}


class SceneView:
    """Shows messages in the scene of a viser server.

    Poses are in world. Called from one thread; what the person does arrives as plain calls from viser's threads.
    Messages that can not be shown, such as poses of unknown links, are left out. While no browser is connected,
    messages are only kept: the newest of each kind is shown when one comes.

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
        watched: Callable[[], bool] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Put the robot into the scene.

        Args:
            server: whose scene is filled.
            robot: not used by another thread.
            around: the camera and the table.
            visible: layers that are shown, or not, other than `LAYERS` says.
            watched: whether anybody looks; else whether a browser is connected.
            clock: the time [s] by which the ghost moves and rates are limited.

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
        self._shown = layers_shown(visible or {})
        self._watched = watched or (lambda: bool(server.get_clients()))
        self._clock = clock
        self._lock = threading.RLock()  # a browser that comes is served on a thread of viser's
        self._newest: dict[str, Any] = {}
        self._editing = False
        self._tf_applied = -math.inf
        self._build(server.scene, robot, around)
        server.on_client_connect(lambda _client: self._show_all())

    def _build(self, scene: viser.SceneApi, robot: RobotModel, around: Surroundings) -> None:
        pieces = visual_pieces(robot)
        rough = coarse(pieces, _GHOST)
        root = {name: f"/{name}" for name in LAYERS}
        self._roots = {
            name: scene.add_frame(path, show_axes=False, visible=self._shown[name]) for name, path in root.items()
        }
        scene.add_grid(
            "/grid/floor", 4.0, 4.0, cell_size=0.1, section_size=0.5, cell_color=(90, 95, 105),
            section_color=(130, 135, 145), position=(0.0, 0.0, -0.002), shadow_opacity=0.0,
        )
        poses = LinkPoses(robot)
        self.figure = Figure(scene, "/robot/links", pieces, poses)
        self.objects = SceneObjects(scene, root["fixtures"], root["objects"], poses)
        self.targets = Targets(scene, root["targets"], 1.35 * around.ball_radius)
        self.rejected = Rejected(scene, root["rejected"], 1.35 * around.ball_radius)
        self.workspace = Workspace(scene, root["workspace"])
        self.frames = Frames(scene, root["frames"])
        self.transforms = Transforms(around.camera)
        self.camera = Camera(scene, root["camera"], self._clock)
        self.plan = Plan(scene, root["plan"], root["tool_path"], rough, robot, self._clock)
        self.outline = Outline(scene, root["outline"])
        self.contours = ContourChoice(scene, root["contours"], around, self._selected)
        self.truth = Truth(scene, root["truth"], self._dragged)
        self.goal = GoalMarker(scene, "/goal", robot, rough, self._goal_moved)

    def _selected(self, index: int) -> None:
        self.on_select(index)

    def _dragged(self, name: str, x: float, y: float) -> None:
        self.on_object_dragged(name, x, y)

    def _goal_moved(self, pose: Pose) -> None:
        self.on_goal_moved(pose)

    # --- layers ---

    def visible(self, layer: str) -> bool:
        """Whether a layer is shown."""
        return self._shown[layer]

    def set_visible(self, layer: str, on: bool) -> None:
        """Show or hide a layer.

        Raises:
            UnknownName: there is no such layer.
        """
        with self._lock:
            self._shown = layers_shown({**self._shown, layer: on})
            self._roots[layer].visible = self._is_shown(layer)
            if on:
                self._apply(*(key for key, layers in _LAYERS_OF.items() if layer in layers))

    def _is_shown(self, layer: str) -> bool:
        return self._shown[layer] or (layer == "truth" and self._editing)

    # --- messages ---

    def show_joints(self, m: JointState) -> None:
        """Move the robot, and a ghost that is playing a plan; call it at most 30 times a second."""
        self._take("joints", m)

    def show_scene(self, m: PlanningScene) -> None:
        """Show fixtures and perceived objects; an attached one moves with its link."""
        self._take("scene", m)

    def show_targets(self, m: PoseArray) -> None:
        """Show where the arm may take something; what was rejected there before is forgotten."""
        with self._lock:
            self.rejected.accept(m)
        self._take("targets", m)

    def show_rejected(self, m: Rejections) -> None:
        """Show, with the reason, what the arm can not take; adds to what was shown before."""
        with self._lock:
            self.rejected.show(m)

    def show_detected(self, m: MarkerArray) -> None:
        """Forget what was rejected where nothing is detected any more."""
        with self._lock:
            self.rejected.look(m)

    def clear_rejected(self) -> None:
        """Forget what was rejected."""
        with self._lock:
            self.rejected.clear()

    def show_workspace(self, m: MarkerArray) -> None:
        """Show the reachable shell and the excluded column."""
        self._take("workspace", m)

    def show_transforms(self, m: TFMessage) -> None:
        """Show frames, of tf or tf_static, and put the camera where its frame is."""
        with self._lock:
            new = self.transforms.update(m)
        if new or self._clock() - self._tf_applied >= _TF_PERIOD:
            self._take("transforms", m)

    def show_camera(self, m: CameraInfo) -> None:
        """Show what the camera sees as a frustum."""
        self._take("camera", m)

    def show_picture(self, rgb: Picture) -> None:
        """Show a picture in the camera's frustum; two a second are taken."""
        self._take("picture", rgb)

    def show_plan(self, m: JointTrajectory) -> None:
        """Show the end of a trajectory as a ghost of the robot, and the path of the tool as a line.

        The ghost goes when the robot has come there.
        """
        self._take("plan", m)

    def play_plan(self) -> None:
        """Let the ghost move along the newest plan, over and over, until the next plan or until the robot moves."""
        with self._lock:
            self.plan.play()

    def show_outline(self, m: OutlinePoints) -> None:
        """Show the outline of the chosen object as a line."""
        self._take("outline", m)

    def show_contours(self, m: Contours) -> None:
        """Show what may be chosen as lines, each with its label and a pin; clicking the pin calls `on_select`."""
        self._take("contours", m)

    def show_truth(self, objects: WorldObjects) -> None:
        """Show where everything really is, beside what was perceived."""
        self._take("world", objects)

    # --- what the person moves ---

    def set_editing(self, on: bool) -> None:
        """Let objects of the simulated world be dragged on the table; they are shown meanwhile."""
        with self._lock:
            self._editing = on
            self._roots["truth"].visible = self._is_shown("truth")
            self._apply("world")
            self.truth.set_editing(on)

    def goal_marker(self, on: bool) -> None:
        """Show or hide the marker that tells a goal for the tool centre point; it appears where the tool is."""
        with self._lock:
            if on and not self.goal.visible:
                q = self.figure.poses.joint_positions(self._robot.joint_names)
                self.goal.pose = matrix_to_pose(self._robot.fk(q))
            self.goal.visible = on

    @property
    def goal_pose(self) -> Pose:
        """Pose of the goal marker in world."""
        return self.goal.pose

    @goal_pose.setter
    def goal_pose(self, pose: Pose) -> None:
        self.goal.pose = pose

    # --- from messages to nodes ---

    def _take(self, key: str, message: Any) -> None:
        """Keep a message, and show it if anybody looks."""
        with self._lock:
            self._newest[key] = message
            if self._watched():
                self._apply(key)

    def _show_all(self) -> None:
        """Show what came while nobody looked."""
        with self._lock:
            self._apply(*_LAYERS_OF)

    def _apply(self, *keys: str) -> None:
        with self._server.atomic():
            for key in keys:
                if key in self._newest and any(self._is_shown(layer) for layer in _LAYERS_OF[key]):
                    getattr(self, f"_apply_{key}")(self._newest[key])

    def _apply_joints(self, m: JointState) -> None:
        if self.figure.move(m.name, m.position):
            self.objects.follow()
        self.plan.follow(self.figure.poses)

    def _apply_scene(self, m: PlanningScene) -> None:
        self.objects.show(m)
        self._apply("contours")  # they lie on the objects

    def _apply_targets(self, m: PoseArray) -> None:
        self.targets.show(m)

    def _apply_workspace(self, m: MarkerArray) -> None:
        self.workspace.show(m)

    def _apply_transforms(self, _m: TFMessage) -> None:
        self._tf_applied = self._clock()
        if self._shown["frames"]:
            self.frames.show(self.transforms.message())
        if "camera" in self._newest:
            self._place_camera(self._newest["camera"])

    def _apply_camera(self, m: CameraInfo) -> None:
        self._place_camera(m)
        self._apply("contours")  # they are seen from there

    def _place_camera(self, m: CameraInfo) -> None:
        if self._shown["camera"]:
            self.camera.show(m, self.transforms.pose(m.header.frame_id))

    def _apply_picture(self, rgb: NDArray[np.uint8]) -> None:
        self.camera.picture(rgb)

    def _apply_plan(self, m: JointTrajectory) -> None:
        self.plan.show(m)

    def _apply_outline(self, m: OutlinePoints) -> None:
        self.outline.show(m)

    def _apply_contours(self, m: Contours) -> None:
        info = self._newest.get("camera")
        if info is None:
            return
        try:
            camera = Pinhole.from_info(info, self.transforms.pose(info.header.frame_id))
        except CameraError:  # a distorted camera: pixels are not where a pinhole would see them
            return
        self.contours.show(m, camera, self._newest.get("scene"))

    def _apply_world(self, m: WorldObjects) -> None:
        self.truth.objects(m)
