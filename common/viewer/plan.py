"""The newest plan: a ghost of the robot where it ends, and the path of the tool as a line."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import numpy as np
import viser
from numpy.typing import NDArray

from common.messages import JointTrajectory
from common.robot.model import RobotModel
from common.viewer.figure import Figure
from common.viewer.link_poses import LinkPoses
from common.viewer.robot_meshes import Piece

Array = NDArray[np.float64]

GHOST = (90, 200, 255)
PATH = (255, 200, 60)
_SAMPLES = 120  # points of the line
_THERE = 0.01  # [rad] the robot is where the plan ends, or has left where it stood
_APART = 0.01  # [m] links no farther than this from the robot's, nor turned by more than 0.03 rad, lie in them
_TURNED = 0.9999  # cosine of half the angle
_REST = 1.0  # [s] at the end, before the ghost begins again


class Plan:
    """Shows one trajectory at a time."""

    def __init__(
        self,
        scene: viser.SceneApi,
        ghost: str,
        path: str,
        pieces: Iterable[Piece],
        robot: RobotModel,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without one.

        Args:
            scene: to which nodes are added.
            ghost, path: names of the nodes under which ghost and line are put.
            pieces: meshes of the ghost.
            robot: whose tool centre point draws the path.
            clock: the time [s] by which the ghost moves.
        """
        self._scene = scene
        self._clock = clock
        self._line_name = f"{path}/line"
        self._line: viser.LineSegmentsHandle | None = None
        self._tool = LinkPoses(robot)
        self._tcp = robot.config.tcp_link
        self.ghost = Figure(scene, f"{ghost}/robot", pieces, LinkPoses(robot), color=GHOST, opacity=0.35, visible=False)
        self._names: list[str] = []
        self._times: Array = np.empty(0)
        self._positions: Array = np.empty((0, 0))
        self._playing: tuple[float, Array | None] | None = None  # since when, and where the robot was then

    def show(self, m: JointTrajectory) -> None:
        """Show this trajectory in place of the last; one without points clears it."""
        self._names = list(m.joint_names)
        self._times = np.array([point.time_from_start for point in m.points])
        self._positions = np.array([point.positions for point in m.points]).reshape(len(m.points), len(self._names))
        self._playing = None
        self._draw()
        self.ghost.visible = len(m.points) > 0
        if len(m.points):
            self.ghost.move(self._names, self._positions[-1].tolist())

    def play(self) -> None:
        """Let the ghost move along the trajectory, over and over."""
        if len(self._times):
            self._playing = (self._clock(), None)
            self.ghost.visible = True

    def follow(self, robot: LinkPoses) -> None:
        """Move the ghost on; it stops playing when the robot moves, and goes when the robot is where the plan ends."""
        if not len(self._times) or not self.ghost.visible:
            return
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
                self._step(self._clock() - since)
            self._part(robot)
            return
        end = self._positions[-1][[self._names.index(name) for name in known]]
        if np.abs(now - end).max(initial=0.0) < _THERE:
            self.ghost.visible = False
        self._part(robot)

    @property
    def playing(self) -> bool:
        """Whether the ghost moves."""
        return self._playing is not None

    def _part(self, robot: LinkPoses) -> None:
        """Hide those links of the ghost that lie in the robot's: neither could be seen well."""
        for link, node in self.ghost.links.items():
            (p, q), (p_robot, q_robot) = self.ghost.poses.pose(link), robot.pose(link)
            node.visible = bool(np.abs(p - p_robot).max() > _APART or abs(q @ q_robot) < _TURNED)

    def _step(self, elapsed: float) -> None:
        time_from_start = elapsed % (self._times[-1] + _REST)
        at = [float(np.interp(time_from_start, self._times, column)) for column in self._positions.T]
        self.ghost.move(self._names, at)

    def _draw(self) -> None:
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(self._times) < 2:
            return
        chosen = np.unique(np.linspace(0, len(self._times) - 1, _SAMPLES).round().astype(int))
        points = []
        for index in chosen:
            self._tool.update(self._names, self._positions[index].tolist())
            points.append(self._tool.pose(self._tcp)[0])
        line = np.stack([points[:-1], points[1:]], axis=1)
        self._line = self._scene.add_line_segments(
            self._line_name, line, PATH, thickness=3.0, thickness_units="screen"
        )
