"""Planning: the newest plan as a ghost of the robot and as a tool path, and the planning scene."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import viser
from numpy.typing import NDArray

from common import topics
from common.messages import CollisionObject, JointTrajectory, MotionStatus
from common.topics import Topic
from page.layers import Layer
from page.nodes import Rgb, Solid, add_line, add_solid, position_of, wxyz_of

if TYPE_CHECKING:
    from page.figure import LinkPoses

Array = NDArray[np.float64]

GHOST: Rgb = (90, 200, 255)
COMPARED: Rgb = (220, 120, 255)
PATH: Rgb = (255, 200, 60)
FIXED_ROLES = ("fixture", "container")
_PATH_SAMPLES = 120  # points of the line
_JOINT_TOLERANCE = 0.01  # [rad] the robot has reached the end of a plan, or has left its start
_SAME_POSITION = 0.01  # [m] and
_SAME_ROTATION = 0.9999  # cosine of half the angle (0.03 rad), at which a ghost's link coincides with the robot's
NO_PLAN = JointTrajectory(joint_names=["none"], points=[])
_PAUSE = 1.0  # [s] at the end of an animation, before it starts again


class EndedMotion:
    """Detects that a published plan is obsolete: an operator has stopped the arm, or its motion has failed."""

    def __init__(self) -> None:
        self._ended = False
        self.stopped = False  # plans of the task are obsolete until an operator starts it

    def update(self, motion: MotionStatus) -> bool:
        """Return whether a motion has just ended before its goal."""
        before, self.stopped = self._ended, bool(motion.stopped)
        self._ended = self.stopped or motion.state in ("aborted", "cancelled")
        return self._ended and not before


class Plan(Layer):
    """A ghost of the robot at the end of the newest plan, or moving along a plan."""

    LABEL = "Planned motion (ghost)"
    LEGEND = (("end of the planned motion", GHOST),)
    COLOR: ClassVar[Rgb] = GHOST
    TOPICS: ClassVar[Sequence[Topic[Any]]] = (topics.DISPLAY_TRAJECTORY, topics.MOTION_STATUS, topics.JOINT_STATES)

    def build(self) -> None:
        """Start without a plan."""
        from page.figure import Figure, LinkPoses

        self._motion = EndedMotion()

        self.ghost = Figure(self.scene, f"{self.root}/robot", self.stage.rough, LinkPoses(self.stage.robot),
                            color=self.COLOR, opacity=0.35, visible=False)
        self._names: list[str] = []
        self._times: Array = np.empty(0)
        self._positions: Array = np.empty((0, 0))
        self._animation: tuple[float, Array | None] | None = None  # start time, and the robot's joints at that time
        self._played = self._compared = -1  # stamps of the requested plan and of the compared one

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Display another plan, or follow the joint states."""
        if topic == topics.JOINT_STATES:
            self._follow()
        elif topic == topics.MOTION_STATUS:
            if self._motion.update(message):
                self._set_plan(NO_PLAN)
        elif message.header.stamp not in (self._played, self._compared) and not self._motion.stopped:
            self._set_plan(message)  # one that is displayed already would restart

    def play(self, plan: JointTrajectory) -> None:
        """Animate a plan in a loop."""
        self._played = plan.header.stamp
        self._set_plan(plan)
        if len(self._times):
            self._animation = (self.stage.clock(), None)

    def compare(self, plan: JointTrajectory | None) -> None:
        """Ignore that plan: the layer `Compared` displays it."""
        if plan is not None:
            self._compared = plan.header.stamp

    @property
    def playing(self) -> bool:
        """Whether an animation runs."""
        return self._animation is not None

    def _set_plan(self, plan: JointTrajectory) -> None:
        """Display a plan; one without points hides the ghost."""
        self._names = list(plan.joint_names)
        self._times = np.array([point.time_from_start for point in plan.points])
        self._positions = np.array([p.positions for p in plan.points]).reshape(len(plan.points), len(self._names))
        self._animation = None
        self.ghost.visible = len(plan.points) > 0
        if len(plan.points):
            self.ghost.move(self._names, self._positions[-1].tolist())

    def _follow(self) -> None:
        """Advance the animation; end it when the robot moves, and hide the ghost when the robot is at its end."""
        if not len(self._times) or not self.ghost.visible:
            return
        robot = self.stage.poses
        known = [name for name in self._names if robot.has_joint(name)]
        now = robot.joint_positions(known)
        if self._animation is not None:
            start, start_joints = self._animation
            if start_joints is None:
                self._animation = (start, now)
            elif np.abs(now - start_joints).max(initial=0.0) > _JOINT_TOLERANCE:
                self._animation = None
                self.ghost.move(self._names, self._positions[-1].tolist())
            else:
                self._animate(self.stage.clock() - start)
        else:
            end = self._positions[-1][[self._names.index(name) for name in known]]
            if np.abs(now - end).max(initial=0.0) < _JOINT_TOLERANCE:
                self.ghost.visible = False
        self._hide_coinciding_links()

    def _hide_coinciding_links(self) -> None:
        """Hide links of the ghost that coincide with the robot's: the two would flicker."""
        for link, node in self.ghost.links.items():
            (p, q), (p_robot, q_robot) = self.ghost.poses.pose(link), self.stage.poses.pose(link)
            node.visible = bool(np.abs(p - p_robot).max() > _SAME_POSITION or abs(q @ q_robot) < _SAME_ROTATION)

    def _animate(self, elapsed: float) -> None:
        time_from_start = elapsed % (self._times[-1] + _PAUSE)
        joints = [float(np.interp(time_from_start, self._times, column)) for column in self._positions.T]
        self.ghost.move(self._names, joints)


class Compared(Plan):
    """A second ghost that moves along the plan of another planner, and its tool path."""

    LABEL = "Compared plan (ghost)"
    LEGEND = (("compared plan", COMPARED),)
    COLOR = COMPARED
    TOPICS = (topics.JOINT_STATES,)

    def build(self) -> None:
        """Start without a plan."""
        from page.figure import LinkPoses

        super().build()
        self._tool = LinkPoses(self.stage.robot)
        self.line: viser.LineSegmentsHandle | None = None

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Advance the animation; remove it once the robot moves."""
        self._follow()
        if self.line is not None and not self.playing:
            self.compare(None)

    def play(self, plan: JointTrajectory) -> None:
        """Do nothing: the layer `Plan` displays it."""

    def compare(self, plan: JointTrajectory | None) -> None:
        """Animate a plan in a loop; None removes it."""
        if self.line is not None:
            self.line.remove()
            self.line = None
        self._set_plan(plan or JointTrajectory(joint_names=self.stage.robot.joint_names, points=[]))
        if plan is not None and len(plan.points) > 1:
            self._animation = (self.stage.clock(), None)
            points = tool_path(self._tool, self.stage.robot.config.tcp_link, plan)
            self.line = add_line(self.scene, f"{self.root}/line", points, COMPARED, 3.0)


class ToolPath(Layer):
    """The path of the tool center point along the newest plan."""

    LABEL = "Planned tool path"
    LEGEND = (("planned tool path", PATH),)
    TOPICS = (topics.DISPLAY_TRAJECTORY, topics.MOTION_STATUS)

    def build(self) -> None:
        """Start without a path."""
        from page.figure import LinkPoses

        self._motion = EndedMotion()
        self._tool = LinkPoses(self.stage.robot)
        self.line: viser.LineSegmentsHandle | None = None
        self._played = self._compared = -1  # stamps

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Display the path of a plan; one without points clears it."""
        if topic == topics.MOTION_STATUS:
            if self._motion.update(message):
                self._draw(NO_PLAN)
        elif message.header.stamp not in (self._played, self._compared) and not self._motion.stopped:
            self._draw(message)

    def compare(self, plan: JointTrajectory | None) -> None:
        """Ignore that plan: the layer `Compared` displays it."""
        if plan is not None:
            self._compared = plan.header.stamp

    def play(self, plan: JointTrajectory) -> None:
        """Display the path of a plan that an operator requested."""
        self._played = plan.header.stamp
        self._draw(plan)

    def _draw(self, plan: JointTrajectory) -> None:
        if self.line is not None:
            self.line.remove()
            self.line = None
        if len(plan.points) < 2:
            return
        points = tool_path(self._tool, self.stage.robot.config.tcp_link, plan)
        self.line = add_line(self.scene, f"{self.root}/line", points, PATH, 3.0)


def tool_path(poses: LinkPoses, tcp: str, plan: JointTrajectory) -> Array:
    """Return positions (n, 3) [m] of the tool center point at some points of a plan."""
    points = []
    for index in np.unique(np.linspace(0, len(plan.points) - 1, _PATH_SAMPLES).round().astype(int)):
        poses.update(plan.joint_names, plan.points[index].positions)
        points.append(poses.pose(tcp)[0].copy())
    return np.array(points)


# --- planning scene ---


class Fixtures(Layer):
    """The fixed objects of the planning scene. Unchanged objects are not sent again."""

    LABEL = "Fixtures"
    TOPICS: ClassVar[Sequence[Topic[Any]]] = (topics.PLANNING_SCENE,)
    MOVABLE: ClassVar[bool] = False

    def build(self) -> None:
        """Start empty."""
        self._numbers = count()
        self._nodes: dict[tuple[str, str], tuple[Any, Solid]] = {}  # appearance and node, by link and id
        self._links: dict[str, viser.FrameHandle] = {}  # nodes of links with attached objects

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Replace the displayed objects; objects attached to an unknown link are left out."""
        objects = {("", each.id): each for each in message.objects if (each.role in FIXED_ROLES) is not self.MOVABLE}
        if self.MOVABLE:
            objects |= {(a.link, a.object.id): a.object for a in message.attached if self.stage.poses.knows(a.link)}
        for key in [key for key in self._nodes if key not in objects]:
            self._nodes.pop(key)[1].remove()
        for (link, name), thing in objects.items():
            self._show(link, name, thing)
        for link in [link for link in self._links if not any(link == on for on, _ in objects)]:
            self._links.pop(link).remove()
        self._follow()

    def node(self, name: str, link: str = "") -> Solid | None:
        """Return the node of an object by its id and the link to which it is attached."""
        found = self._nodes.get((link, name))
        return found[1] if found else None

    def _follow(self) -> None:
        """Move attached objects with their links."""
        for link, node in self._links.items():
            node.position, node.wxyz = self.stage.poses.pose(link)

    def _show(self, link: str, name: str, thing: CollisionObject) -> None:
        appearance = (thing.shape, thing.dimensions, thing.outline, thing.color)
        known = self._nodes.get((link, name))
        if known is not None and known[0] == appearance:
            known[1].position, known[1].wxyz = position_of(thing.pose), wxyz_of(thing.pose)
            return
        if known is not None:
            self._nodes.pop((link, name))[1].remove()
        node = add_solid(self.scene, f"{self._parent(link)}/{next(self._numbers)}", thing)
        if node is not None:
            self._nodes[link, name] = (appearance, node)

    def _parent(self, link: str) -> str:
        if not link:
            return self.root
        root = f"{self.root}/held_by_{link}"
        if link not in self._links:
            self._links[link] = self.scene.add_frame(root, show_axes=False)
        return root


class Objects(Fixtures):
    """The perceived and attached objects of the planning scene."""

    LABEL = "Perceived objects"
    TOPICS = (topics.PLANNING_SCENE, topics.JOINT_STATES)
    MOVABLE = True

    def show(self, topic: Topic[Any], message: Any) -> None:
        """Replace the displayed objects, or move attached ones with the robot."""
        if topic == topics.JOINT_STATES:
            self._follow()
        else:
            super().show(topic, message)
