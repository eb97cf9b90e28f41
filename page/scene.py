"""The 3D scene of the page: its layers and when each is updated, and the marker for a goal of the tool."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import viser

from common import topics
from common.config import Surroundings
from common.messages import JointTrajectory, Pose
from common.robot.model import RobotModel
from common.robot.transforms import invert, matrix_to_pose
from common.robot.visual_meshes import Piece, coarse, visual_pieces
from common.topics import Topic
from page.camera_panel import RgbImage
from page.console import Console
from page.feeds import Latest, Updater
from page.figure import LinkPoses, Transforms
from page.layers import Layers, Stage, shown_layers
from page.nodes import FLAT, Projection, matrix_wxyz, pose_from, position_of, projection_of, wxyz_of

GHOST_DETAIL = 0.3  # share of the robot's triangles that a ghost has


class Scene:
    """The layers of a cell in the scene of a server. Used by one thread at a time.

    Messages that cannot be displayed, such as poses of unknown links, are left out.

    Attributes:
        stage: what the layers use.
        layers: by name.
        goal: the marker for a goal of the tool.
    """

    def __init__(
        self, server: viser.ViserServer, robot: RobotModel, around: Surroundings, layers: Layers, console: Console,
        latest: Latest, *, shown: Mapping[str, bool] | None = None, clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create the layers; takes seconds.

        Args:
            server: whose scene is filled.
            robot: not used by another thread.
            around: known surroundings of the robot.
            layers: of the cell.
            console: of the page.
            latest: source of the newest message of a topic.
            shown: visibility of layers, where it differs from their default.
            clock: time [s] of animations.

        Raises:
            UnknownName: a layer in `shown` does not exist.
            ConfigError: a mesh of the robot cannot be read.
        """
        self._kinds, self._shown = layers, shown_layers(shown or {}, layers)
        self._server, self._editing = server, False
        pieces = visual_pieces(robot)
        self.stage = Stage(server.scene, robot, around, console, latest, clock, LinkPoses(robot),
                           Transforms(around.cameras.values()), pieces, coarse(pieces, GHOST_DETAIL), self._projection)
        self._roots = {name: server.scene.add_frame(f"/{name}", show_axes=False, visible=self._shown[name])
                       for name in layers}
        self.layers = {name: kind(self.stage, f"/{name}") for name, kind in layers.items()}
        self._updaters = {name: Updater(layer, latest) for name, layer in self.layers.items()}
        self.goal = GoalMarker(server.scene, "/goal", robot, self.stage.rough)

    def _projection(self) -> Projection | None:
        """Return the projection of the browser that has been connected longest: labels are placed for it."""
        for client in self._server.get_clients().values():
            if client.camera.image_height > 0:
                return projection_of(client.camera)
        return None

    # --- layers ---

    def is_visible(self, name: str) -> bool:
        """Return whether a layer is visible: it is switched on, or it is used for editing the simulated world."""
        return self._shown[name] or (self.layers[name].EDITS and self._editing)

    def set_shown(self, name: str, on: bool) -> None:
        """Show or hide a layer.

        Raises:
            UnknownName: the layer does not exist.
        """
        self._shown = shown_layers({**self._shown, name: on}, self._kinds)
        self._roots[name].visible = self.is_visible(name)

    def set_editing(self, on: bool) -> None:
        """Make objects of the simulated world draggable, and show them meanwhile."""
        self._editing = on
        for name, layer in self.layers.items():
            if layer.EDITS:
                self._roots[name].visible = self.is_visible(name)
                layer.edit(on)

    def refresh(self, now: float) -> None:
        """Update visible layers at a wall time [s], monotonic; call it up to 30 times a second while a page is open.

        A hidden layer receives the newest messages when it becomes visible.
        """
        stage = self.stage
        if (joints := stage.latest(topics.JOINT_STATES)) is not None:
            stage.poses.update(joints.name, joints.position)
        for topic in (topics.TF_STATIC, topics.TF):
            if (transforms := stage.latest(topic)) is not None:
                stage.transforms.update(transforms)
        with self._server.atomic():
            for name, updater in self._updaters.items():
                if self.is_visible(name):
                    updater.update(now)

    def handle_event(self, topic: Topic[Any], event: Any) -> None:
        """Pass an event to the layers, also to hidden ones: it is not published again."""
        for layer in self.layers.values():
            if any(topic.key == other.key for other in layer.TOPICS):
                layer.show(topic, event)

    def show_image(self, topic: Topic[Any], rgb: RgbImage) -> None:
        """Display an image of a camera in the scene."""
        for name, layer in self.layers.items():
            if self.is_visible(name):
                layer.show_image(topic, rgb)

    def play(self, plan: JointTrajectory) -> None:
        """Animate the ghost along a plan in a loop, until the next plan or until the robot moves."""
        for layer in self.layers.values():
            layer.play(plan)

    def compare(self, plan: JointTrajectory | None) -> None:
        """Animate a second ghost along another plan; None removes it."""
        for layer in self.layers.values():
            layer.compare(plan)

    # --- goal marker ---

    def show_goal_marker(self, on: bool) -> None:
        """Show or hide the goal marker; it appears at the tool."""
        if on and not self.goal.visible:
            robot = self.stage.robot
            self.goal.pose = matrix_to_pose(robot.fk(self.stage.poses.joint_positions(robot.joint_names)))
        self.goal.visible = on

    @property
    def goal_pose(self) -> Pose:
        """Pose of the goal marker in world."""
        return self.goal.pose

    def set_goal_reachable(self, reachable: bool | None) -> None:
        """Show whether the arm can reach the goal marker; None: unknown."""
        self.goal.set_reachable(reachable)


class GoalMarker:
    """A draggable gizmo with a ghost of the gripper; its pose is the goal of the tool center point."""

    NEUTRAL, REACHABLE, UNREACHABLE = (255, 170, 60), (60, 200, 100), (240, 60, 60)
    SIZE = 0.18  # [m]
    MAX_DISTANCE, NORM_TOLERANCE = 100.0, 1e-3  # of valid poses: [m] from the world's origin; of the quaternion's norm

    def __init__(self, scene: viser.SceneApi, name: str, robot: RobotModel, pieces: Iterable[Piece]) -> None:
        """Add it, hidden, at the tool's home pose.

        Args:
            scene: to which it is added.
            name: of its node.
            robot: whose tool it is for.
            pieces: meshes of the robot; those that move with the tool are shown.
        """
        links = robot.link_poses(robot.named("home"))
        T_world_tcp = links[robot.config.tcp_link]
        self._node = scene.add_transform_controls(
            name, scale=self.SIZE, depth_test=False, opacity=0.9, visible=False, position=T_world_tcp[:3, 3],
            wxyz=matrix_wxyz(T_world_tcp), line_width=3.0,
        )
        self._last_valid = matrix_to_pose(T_world_tcp)
        tool = _tool_links(robot)
        self._scene = scene
        self._meshes: list[viser.MeshHandle] = []
        self._color = self.NEUTRAL
        self._pending = [(piece, invert(T_world_tcp) @ links[piece.link]) for piece in pieces if piece.link in tool]

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self._node.visible

    @visible.setter
    def visible(self, on: bool) -> None:
        if on:
            self._send_meshes()
        self._node.visible = on

    @property
    def pose(self) -> Pose:
        """Pose in world; an invalid or distant pose from a browser is reverted."""
        position, wxyz = np.array(self._node.position, float), np.array(self._node.wxyz, float)
        valid = np.all(np.abs(position) <= self.MAX_DISTANCE) and abs(np.linalg.norm(wxyz) - 1) < self.NORM_TOLERANCE
        if valid:
            self._last_valid = pose_from(position, wxyz)
        else:
            self.pose = self._last_valid
        return self._last_valid

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._node.position, self._node.wxyz = position_of(pose), wxyz_of(pose)

    def set_reachable(self, reachable: bool | None) -> None:
        """Color it green or red; None: unknown."""
        color = self.NEUTRAL if reachable is None else self.REACHABLE if reachable else self.UNREACHABLE
        if color != self._color:
            self._color = color
            for node in self._meshes:
                node.color = color

    def _send_meshes(self) -> None:
        """Send the meshes once they are needed: a browser spends time on hidden meshes too."""
        for number, (piece, T_tcp_link) in enumerate(self._pending):
            self._meshes.append(self._scene.add_mesh_simple(
                f"{self._node.name}/{number}", piece.vertices, piece.faces, color=self._color, opacity=0.45,
                position=T_tcp_link[:3, 3], wxyz=matrix_wxyz(T_tcp_link), **FLAT,
            ))
        self._pending.clear()


def _tool_links(robot: RobotModel) -> set[str]:
    """Return the links that move with the last joint of the arm."""
    model = robot.full_model
    last = model.getJointId(robot.joint_names[-1])
    return {f.name for f in model.frames if f.name in robot.link_names and last in list(model.supports[f.parentJoint])}
