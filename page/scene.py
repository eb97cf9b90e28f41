"""The 3D scene of the page: its layers, and when each of them shows what."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import viser

from common import topics
from common.config import Surroundings
from common.messages import JointTrajectory, Pose
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.robot.visual_meshes import coarse, visual_pieces
from common.topics import Topic
from page.console import Console
from page.feeds import Latest, News
from page.figure import LinkPoses, Transforms
from page.goal_marker import GoalMarker
from page.labels import View, view_of
from page.layers import Layers, layers_shown
from page.pictures import Picture
from page.stage import Stage

GHOST = 0.3  # share of the robot's triangles that its ghost has


class Scene:
    """The layers of a cell on a server's scene. Used by one thread at a time.

    Messages that cannot be shown, such as poses of unknown links, are left out.

    Attributes:
        stage: what the layers stand on.
        layers: by name.
        goal: the marker for a goal of the tool.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        robot: RobotModel,
        around: Surroundings,
        layers: Layers,
        console: Console,
        latest: Latest,
        *,
        shown: Mapping[str, bool] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Put the layers on a stage; takes seconds.

        Args:
            server: whose scene is filled.
            robot: not used by another thread.
            around: what everybody knows of the world.
            layers: of the cell.
            console: of the page.
            latest: the newest message of a topic.
            shown: layers that are shown, or not, other than usual.
            clock: the time [s] by which things move that no message moves.

        Raises:
            UnknownName: a layer in `shown` does not exist.
            ConfigError: a mesh of the robot cannot be read.
        """
        self._kinds, self._shown = layers, layers_shown(shown or {}, layers)
        self._server, self._editing = server, False
        pieces = visual_pieces(robot)
        self.stage = Stage(server.scene, robot, around, console, latest, clock, LinkPoses(robot),
                           Transforms(around.cameras.values()), pieces, coarse(pieces, GHOST), self._view)
        self._roots = {name: server.scene.add_frame(f"/{name}", show_axes=False, visible=self._shown[name])
                       for name in layers}
        self.layers = {name: kind(self.stage, f"/{name}") for name, kind in layers.items()}
        self._news = {name: News(layer, latest) for name, layer in self.layers.items()}
        self.goal = GoalMarker(server.scene, "/goal", robot, self.stage.rough)

    def _view(self) -> View | None:
        """How the scene is seen by who has it open longest: words are placed for them."""
        for client in self._server.get_clients().values():
            if client.camera.image_height > 0:
                return view_of(client.camera)
        return None

    # --- layers ---

    def shows(self, name: str) -> bool:
        """Whether a layer is seen: it is ticked, or it serves to edit the world and that is what is done."""
        return self._shown[name] or (self.layers[name].EDITS and self._editing)

    def set_shown(self, name: str, on: bool) -> None:
        """Show or hide a layer.

        Raises:
            UnknownName: there is no such layer.
        """
        self._shown = layers_shown({**self._shown, name: on}, self._kinds)
        self._roots[name].visible = self.shows(name)

    def set_editing(self, on: bool) -> None:
        """Let objects of the simulated world be dragged; they are shown meanwhile."""
        self._editing = on
        for name, layer in self.layers.items():
            if layer.EDITS:
                self._roots[name].visible = self.shows(name)
                layer.edit(on)

    # --- what they show ---

    def refresh(self, now: float) -> None:
        """Show what is new at a wall time [s], monotonic; to be called while somebody looks, 30 times a second at most.

        A layer that is hidden is told what came meanwhile when it is shown again.
        """
        stage = self.stage
        if (joints := stage.latest(topics.JOINT_STATES)) is not None:
            stage.poses.update(joints.name, joints.position)
        for topic in (topics.TF_STATIC, topics.TF):
            if (transforms := stage.latest(topic)) is not None:
                stage.transforms.update(transforms)
        with self._server.atomic():
            for name, news in self._news.items():
                if self.shows(name):
                    news.tell(now)

    def happened(self, topic: Topic[Any], event: Any) -> None:
        """Tell the layers of an event, also those that are hidden: it does not come again."""
        for layer in self.layers.values():
            if any(topic.key == other.key for other in layer.TOPICS):
                layer.show(topic, event)

    def picture(self, topic: Topic[Any], rgb: Picture) -> None:
        """Show a picture of a camera within the scene, too."""
        for name, layer in self.layers.items():
            if self.shows(name):
                layer.picture(topic, rgb)

    def play(self, plan: JointTrajectory) -> None:
        """Let the ghost of the robot move along a plan, over and over, until the next or until the robot moves."""
        for layer in self.layers.values():
            layer.play(plan)

    def compare(self, plan: JointTrajectory | None) -> None:
        """Let a second ghost move along another plan beside the first; None: none any more."""
        for layer in self.layers.values():
            layer.compare(plan)

    # --- what the person moves ---

    def goal_marker(self, on: bool) -> None:
        """Show or hide the marker that tells a goal for the tool centre point; it appears where the tool is."""
        if on and not self.goal.visible:
            robot = self.stage.robot
            self.goal.pose = matrix_to_pose(robot.fk(self.stage.poses.joint_positions(robot.joint_names)))
        self.goal.visible = on

    @property
    def goal_pose(self) -> Pose:
        """Pose of the goal marker in world."""
        return self.goal.pose

    def goal_reached(self, reached: bool | None) -> None:
        """Show whether the arm can be at the goal marker; None: not known."""
        self.goal.show_reached(reached)
