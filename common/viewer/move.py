"""How a person has the arm moved to a goal of their own: a panel, and a marker in the scene to pull about."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import viser

from common.errors import ZencellError
from common.messages import JointGoal, JointTrajectory, MotionStatus, PlanResponse, Pose, PoseGoal
from common.robot.transforms import invert
from common.viewer.console import Desk, assign
from common.viewer.markup import block, span, text
from common.viewer.nodes import FLAT, matrix_wxyz, pose_from, position_of, wxyz_of
from common.viewer.words import plan, problem

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from common.viewer.robot_meshes import Piece

PIPELINE = "pipeline"
PLAN, GO = "Plan here", "Go there"
HAND = (255, 170, 60)
_SIZE = 0.18  # of the marker [m]


class Motions(Protocol):
    """Plans and moves for a person; with no planner named, by the cell's pipeline."""

    async def plan(self, goal: PoseGoal | JointGoal, *, planner: str = "") -> PlanResponse:
        """A plan to a goal; nothing moves."""

    async def move(self, goal: PoseGoal | JointGoal, *, planner: str = "") -> MotionStatus:
        """The end of a motion to a goal."""


class Goal(Protocol):
    """Where the goal marker is in the scene."""

    def goal_marker(self, on: bool) -> None:
        """Show or hide it."""

    @property
    def goal_pose(self) -> Pose:
        """Its pose in world."""


class MovePanel:
    """A tick for the goal marker, a list of planners, buttons to plan and go, and how it went."""

    def __init__(
        self, gui: viser.GuiApi, desk: Desk, motions: Motions, goal: Goal,
        planners: Sequence[str], *, planner: str, marker: bool, tell: Callable[[str, str], None],
        play: Callable[[JointTrajectory], None],
    ) -> None:
        """Lay the panel out where the GUI stands.

        Args:
            gui: of the server.
            desk: takes the orders.
            motions: carry them out.
            goal: the goal marker.
            planners: that may be asked.
            planner: that is asked at first.
            marker: whether the goal marker is shown at first.
            tell: called with a line about how it went, and whether that is good, busy or bad.
            play: shows a plan as a motion.
        """
        self._motions, self._goal, self._tell_all, self._play = motions, goal, tell, play
        self.planner = planner if planner in planners else PIPELINE
        self.marker = marker
        self._tick = gui.add_checkbox("Goal marker", marker, hint="drag it in the scene to where the tool should be")
        desk.on_change(self._tick, self.set_marker)
        names = gui.add_dropdown("Planner", [PIPELINE, *planners], initial_value=self.planner,
                                 hint="pipeline: the cell's planners, in their order")
        desk.on_change(names, self._set_planner)
        desk.on_choice(gui.add_button_group("Goal", (PLAN, GO)), self._go)
        if marker:
            goal.goal_marker(True)
        self._html = gui.add_html(_line("Show the goal marker, drag it, then plan or go there.", "dim"))

    def set_marker(self, on: bool) -> None:
        """Show or hide the goal marker."""
        self.marker = on
        assign(self._tick, on)
        self._goal.goal_marker(on)

    async def go_home(self) -> None:
        """Have the arm go home."""
        await self._do(self._move(JointGoal(named="home"), "", "At home"), "Going home …")

    async def _go(self, chosen: str) -> None:
        if not self.marker:
            self.set_marker(True)
            self._tell("Drag the goal marker to where the tool should be, then try again.", "busy")
            return
        planner = "" if self.planner == PIPELINE else self.planner
        there = PoseGoal(pose=self._goal.goal_pose)
        if chosen == PLAN:
            await self._do(self._plan(there, planner), "Planning …")
        elif chosen == GO:
            await self._do(self._move(there, planner, "There"), "Planning and going there …")

    async def _do(self, doing: Coroutine[Any, Any, None], line: str) -> None:
        self._tell(line, "busy")
        try:
            await doing
        except ZencellError as error:
            self._tell(problem(error), "bad")

    async def _plan(self, goal: PoseGoal, planner: str) -> None:
        response = await self._motions.plan(goal, planner=planner)
        self._tell(plan(response), "good" if response.ok else "bad")
        if response.ok and response.trajectory is not None:
            self._play(response.trajectory)

    async def _move(self, goal: PoseGoal | JointGoal, planner: str, there: str) -> None:
        await self._motions.move(goal, planner=planner)
        self._tell(there, "good")

    def _set_planner(self, name: str) -> None:
        self.planner = name

    def _tell(self, line: str, kind: str) -> None:
        self._html.content = _line(line, kind)
        self._tell_all(line, kind)


def _line(line: str, kind: str) -> str:
    return block(f"{span('●', kind + ' dot')} {text(line)}", "move", kind=kind)


class GoalMarker:
    """A gizmo with the gripper in it: where the tool centre point is to go."""

    def __init__(self, scene: viser.SceneApi, name: str, robot: RobotModel, pieces: Iterable[Piece]) -> None:
        """Put it, hidden, where the tool is at home.

        Args:
            scene: to which it is added.
            name: of its node.
            robot: whose tool it is for.
            pieces: meshes of the robot; those that move with the tool are shown.
        """
        links = robot.link_poses(robot.named("home"))
        T_world_tcp = links[robot.config.tcp_link]
        self._node = scene.add_transform_controls(
            name, scale=_SIZE, depth_test=False, opacity=0.9, visible=False, position=T_world_tcp[:3, 3],
            wxyz=matrix_wxyz(T_world_tcp), line_width=3.0,
        )
        hand = _hand(robot)
        self._scene = scene
        self._undrawn = [(piece, invert(T_world_tcp) @ links[piece.link]) for piece in pieces if piece.link in hand]

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self._node.visible

    @visible.setter
    def visible(self, on: bool) -> None:
        if on:
            self._draw()
        self._node.visible = on

    @property
    def pose(self) -> Pose:
        """Where it is, in world."""
        return pose_from(np.array(self._node.position), np.array(self._node.wxyz))

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._node.position, self._node.wxyz = position_of(pose), wxyz_of(pose)

    def _draw(self) -> None:
        """Send the meshes, once: a browser takes its time over meshes that are hidden, too."""
        for number, (piece, T_tcp_link) in enumerate(self._undrawn):
            self._scene.add_mesh_simple(
                f"{self._node.name}/{number}", piece.vertices, piece.faces, color=HAND, opacity=0.45,
                position=T_tcp_link[:3, 3], wxyz=matrix_wxyz(T_tcp_link), **FLAT,
            )
        self._undrawn.clear()


def _hand(robot: RobotModel) -> set[str]:
    """Links that hang on the last joint of the arm, with those that hang on them."""
    model = robot.full_model
    last = model.getJointId(robot.joint_names[-1])
    return {f.name for f in model.frames if f.name in robot.link_names and last in list(model.supports[f.parentJoint])}
