"""The robot as it is, and the shapes that collisions are looked for with; where the newest plan ends, or a ghost moving
along it; and the path of its tool.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import viser
from numpy.typing import NDArray

from common import topics
from common.messages import JointTrajectory
from common.topics import Topic
from page.layers import Layer
from page.nodes import Rgb, add_line

if TYPE_CHECKING:
    from page.figure import Figure, LinkPoses

Array = NDArray[np.float64]

GHOST = (90, 200, 255)
PATH = (255, 200, 60)
COLLISION = (255, 120, 90)
OTHER = (220, 120, 255)
_SAMPLES = 120  # points of the line
_THERE = 0.01  # [rad] the robot is where the plan ends, or has left where it stood
_APART = 0.01  # [m] links no farther than this from the robot's, nor turned by more than 0.03 rad, lie in them
_TURNED = 0.9999  # cosine of half the angle
_REST = 1.0  # [s] at the end, before the ghost begins again


class Robot(Layer):
    """The robot as it is."""

    LABEL = "Robot"
    TOPICS = (topics.JOINT_STATES,)

    def build(self) -> None:
        """Add its meshes, at home."""
        from page.figure import Figure  # brings kinematics, which only a scene needs

        self.figure = Figure(self.scene, f"{self.root}/links", self.stage.pieces, self.stage.poses)

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Be where the stage says."""
        self.figure.follow()


class CollisionShapes(Layer):
    """What collisions are looked for with."""

    LABEL = "Robot: collision shapes"
    ON = False
    TOPICS = (topics.JOINT_STATES,)
    LEGEND = (("collision shape of the robot", COLLISION),)

    def build(self) -> None:
        """Start without: reading them takes a while, and few look at them."""
        self.figure: Figure | None = None
        self._begun = False

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Be where the stage says."""
        if self.figure is not None:
            self.figure.follow()
        elif not self._begun:
            self._begun = True
            self.stage.console.put(self._load)

    async def _load(self) -> None:
        from common.robot.visual_meshes import collision_pieces
        from page.figure import Figure

        pieces = await asyncio.to_thread(collision_pieces, self.stage.robot)
        self.figure = Figure(self.scene, f"{self.root}/links", pieces, self.stage.poses, color=COLLISION, opacity=0.5)


class Plan(Layer):
    """A ghost of the robot."""

    LABEL = "Planned: where the arm will be"
    LEGEND = (("where the planned motion ends", GHOST),)
    COLOR: ClassVar[Rgb] = GHOST
    TOPICS: ClassVar[Sequence[Topic[Any]]] = (topics.DISPLAY_TRAJECTORY, topics.JOINT_STATES)

    def build(self) -> None:
        """Start without a plan."""
        from page.figure import Figure, LinkPoses

        self.ghost = Figure(self.scene, f"{self.root}/robot", self.stage.rough, LinkPoses(self.stage.robot),
                            color=self.COLOR, opacity=0.35, visible=False)
        self._names: list[str] = []
        self._times: Array = np.empty(0)
        self._positions: Array = np.empty((0, 0))
        self._playing: tuple[float, Array | None] | None = None  # since when, and where the robot was then
        self._played = self._beside = -1  # stamps of the plan that a person asked for, and of the one beside it

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Take another plan, or do what the robot's motion means for the ghost."""
        if topic == topics.JOINT_STATES:
            self._follow()
        elif message.header.stamp not in (self._played, self._beside):  # else it is on show and would begin anew
            self._take(message)

    def play(self, plan: JointTrajectory) -> None:
        """Let the ghost move along a plan, over and over."""
        self._played = plan.header.stamp
        self._take(plan)
        if len(self._times):
            self._playing = (self.stage.clock(), None)

    def compare(self, plan: JointTrajectory | None) -> None:
        """Leave that plan to the ghost beside, although it is the newest."""
        if plan is not None:
            self._beside = plan.header.stamp

    @property
    def playing(self) -> bool:
        """Whether the ghost moves."""
        return self._playing is not None

    def _take(self, plan: JointTrajectory) -> None:
        """Show a plan in place of the last; one without points clears it."""
        self._names = list(plan.joint_names)
        self._times = np.array([point.time_from_start for point in plan.points])
        self._positions = np.array([p.positions for p in plan.points]).reshape(len(plan.points), len(self._names))
        self._playing = None
        self.ghost.visible = len(plan.points) > 0
        if len(plan.points):
            self.ghost.move(self._names, self._positions[-1].tolist())

    def _follow(self) -> None:
        """Move the ghost on; it stops playing when the robot moves, and goes when the robot is where the plan ends."""
        if not len(self._times) or not self.ghost.visible:
            return
        robot = self.stage.poses
        known = [name for name in self._names if robot.has_joint(name)]
        now = robot.joint_positions(known)
        if self._playing is not None:
            since, stood = self._playing
            if stood is None:
                self._playing = (since, now)
            elif np.abs(now - stood).max(initial=0.0) > _THERE:
                self._playing = None
                self.ghost.move(self._names, self._positions[-1].tolist())
            else:
                self._step(self.stage.clock() - since)
        else:
            end = self._positions[-1][[self._names.index(name) for name in known]]
            if np.abs(now - end).max(initial=0.0) < _THERE:
                self.ghost.visible = False
        self._part()

    def _part(self) -> None:
        """Hide those links of the ghost that lie in the robot's: neither could be seen well."""
        for link, node in self.ghost.links.items():
            (p, q), (p_robot, q_robot) = self.ghost.poses.pose(link), self.stage.poses.pose(link)
            node.visible = bool(np.abs(p - p_robot).max() > _APART or abs(q @ q_robot) < _TURNED)

    def _step(self, elapsed: float) -> None:
        time_from_start = elapsed % (self._times[-1] + _REST)
        at = [float(np.interp(time_from_start, self._times, column)) for column in self._positions.T]
        self.ghost.move(self._names, at)


class Compared(Plan):
    """A ghost that moves along what another planner found, beside the first, and the path of its tool."""

    LABEL = "Planned: what it is compared with"
    LEGEND = (("plan that it is compared with", OTHER),)
    COLOR = OTHER
    TOPICS = (topics.JOINT_STATES,)

    def build(self) -> None:
        """Start without a plan."""
        from page.figure import LinkPoses

        super().build()
        self._tool = LinkPoses(self.stage.robot)
        self.line: viser.LineSegmentsHandle | None = None

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Move on; be gone once the robot moves."""
        self._follow()
        if self.line is not None and not self.playing:
            self.compare(None)

    def play(self, plan: JointTrajectory) -> None:
        """Leave that to the first."""

    def compare(self, plan: JointTrajectory | None) -> None:
        """Move along a plan, over and over; None: be gone."""
        if self.line is not None:
            self.line.remove()
            self.line = None
        self._take(plan or JointTrajectory(joint_names=self.stage.robot.joint_names, points=[]))
        if plan is not None and len(plan.points) > 1:
            self._playing = (self.stage.clock(), None)
            points = tool_points(self._tool, self.stage.robot.config.tcp_link, plan)
            self.line = add_line(self.scene, f"{self.root}/line", points, OTHER, 3.0)


def tool_points(poses: LinkPoses, tcp: str, plan: JointTrajectory) -> Array:
    """(n, 3) where the tool centre point is along a plan [m], at some of its points."""
    points = []
    for index in np.unique(np.linspace(0, len(plan.points) - 1, _SAMPLES).round().astype(int)):
        poses.update(plan.joint_names, plan.points[index].positions)
        points.append(poses.pose(tcp)[0].copy())
    return np.array(points)


class ToolPath(Layer):
    """The path of the tool centre point as a line."""

    LABEL = "Planned: path of the tool"
    LEGEND = (("planned path of the tool", PATH),)
    TOPICS = (topics.DISPLAY_TRAJECTORY,)

    def build(self) -> None:
        """Start without one."""
        from page.figure import LinkPoses

        self._tool = LinkPoses(self.stage.robot)
        self.line: viser.LineSegmentsHandle | None = None
        self._played = self._beside = -1  # stamps

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Draw the path of a plan in place of the last; one without points clears it."""
        if message.header.stamp not in (self._played, self._beside):
            self._draw(message)

    def compare(self, plan: JointTrajectory | None) -> None:
        """Leave that plan to what is drawn beside, although it is the newest."""
        if plan is not None:
            self._beside = plan.header.stamp

    def play(self, plan: JointTrajectory) -> None:
        """Draw the path of a plan that a person asked for."""
        self._played = plan.header.stamp
        self._draw(plan)

    def _draw(self, plan: JointTrajectory) -> None:
        if self.line is not None:
            self.line.remove()
            self.line = None
        if len(plan.points) < 2:
            return
        points = tool_points(self._tool, self.stage.robot.config.tcp_link, plan)
        self.line = add_line(self.scene, f"{self.root}/line", points, PATH, 3.0)
