"""Fields of the Move tab that select a goal: the goal marker, numbers, a named or a saved pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import viser

from common.messages import JointGoal, JointTrajectory, Pose, PoseGoal
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix, transform
from page.console import Console, assign

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from page.manual_control import ArmReadout, Numbers

Goal = PoseGoal | JointGoal
Report = Callable[[str, str], None]  # shows a line and its kind

MARKER, TOOL, JOINTS = "goal marker", "tool pose", "joint positions"
MARKER_DEBOUNCE = 0.5  # [s] without motion of the marker, after which the slow search for a reason starts
IK_RESTARTS = 20


class GoalScene(Protocol):
    """Goal marker and ghosts: `Scene`."""

    def show_goal_marker(self, on: bool) -> None:
        """Show or hide the goal marker."""

    def set_goal_reachable(self, reachable: bool | None) -> None:
        """Show whether the arm can reach the goal marker."""

    @property
    def goal_pose(self) -> Pose:
        """Pose of the goal marker in world."""

    def play(self, plan: JointTrajectory) -> None:
        """Animate a plan."""

    def compare(self, plan: JointTrajectory | None) -> None:
        """Animate another plan; None removes it."""


class GoalFields:
    """Selection of a goal: the marker, a tool pose or joint positions in numbers, a named or saved pose.

    Attributes:
        kind: the selected goal.
        marker: whether the goal marker is shown.
    """

    def __init__(
        self, gui: viser.GuiApi, console: Console, scene: GoalScene, robot: RobotModel, readout: ArmReadout, *,
        marker: bool, on_change: Callable[[], None], report: Report, saved: Callable[[str], list[float]],
    ) -> None:
        """Build the fields.

        Args:
            gui: of the server.
            console: runs changes of the fields.
            scene: has the goal marker.
            robot: not used by another thread.
            readout: of the robot.
            marker: whether the goal marker is shown at first.
            on_change: called when another goal is selected.
            report: shows a line.
            saved: returns the joint positions of a saved pose.
        """
        self._scene, self._robot, self._readout = scene, robot, readout
        self._on_change, self._report, self._saved = on_change, report, saved
        self.kind, self.marker = MARKER, marker
        self._checked: tuple[Pose, float, bool] | None = None  # pose, since when [s], whether the check is complete
        self._xyz, self._rpy, self._q = readout.convert(robot.named("home"))
        self._choice = gui.add_dropdown("Goal", [MARKER], initial_value=MARKER)
        console.on_change(self._choice, self._set_kind)
        self._checkbox = gui.add_checkbox(
            "Show goal marker", marker, hint="drag it in the scene to the goal of the tool")
        console.on_change(self._checkbox, self.set_marker)
        self._position = gui.add_vector3(
            "Tool position [mm]", self._xyz, step=1.0, visible=False, hint="x, y, z in the world frame")
        self._rotation = gui.add_vector3("Tool rotation [°]", self._rpy, step=1.0, visible=False,
                                         hint="roll, pitch, yaw: about x, y and z of the world frame, in that order")
        console.on_change(self._position, self._set_xyz)
        console.on_change(self._rotation, self._set_rpy)
        self._angles = [gui.add_number(f"{name} {unit}", value, step=0.1, visible=False)
                        for name, unit, value in zip(robot.joint_names, readout.units, self._q, strict=True)]
        for number, field in enumerate(self._angles):
            console.on_change(field, self._joint_setter(number))
        if marker:
            scene.show_goal_marker(True)

    @property
    def numeric(self) -> bool:
        """Whether the goal is entered in numbers."""
        return self.kind in (TOOL, JOINTS)

    def goal(self) -> Goal | None:
        """Return the selected goal; None if the marker had to be shown first.

        Raises:
            ConfigError: the saved pose no longer exists.
        """
        if self.kind == TOOL:
            rotation = rpy_to_matrix(*(math.radians(value) for value in self._rpy))
            x, y, z = (1e-3 * value for value in self._xyz)
            return PoseGoal(pose=matrix_to_pose(transform(rotation, (x, y, z))))
        if self.kind == JOINTS:
            return JointGoal(positions=(np.array(self._q) / self._readout.scales).tolist())
        if self.kind in self._robot.config.named_poses:
            return JointGoal(named=self.kind)
        if self.kind != MARKER:
            return JointGoal(positions=self._saved(self.kind))
        if self.marker:
            return PoseGoal(pose=self._scene.goal_pose)
        self.set_marker(True)
        self._report("Drag the goal marker to the goal of the tool, then try again.", "busy")
        return None

    def set_marker(self, on: bool) -> None:
        """Show or hide the goal marker."""
        self.marker, self._checked = on, None
        assign(self._checkbox, on)
        self._scene.show_goal_marker(on)

    def offer(self, saved: Sequence[str]) -> None:
        """Update the choices after saved poses have changed."""
        options = [MARKER, TOOL, JOINTS, *self._robot.config.named_poses, *saved]
        self._choice.options = options
        if self.kind not in options:
            self._set_kind(MARKER)
        assign(self._choice, self.kind)

    def check_marker(self, now: float) -> tuple[str, str] | None:
        """Return a new line on whether the arm can reach the marker, and its kind; a marker at rest gets the reason."""
        from common.planning.ik import explain_ik_failure, solve_ik

        if not self.marker or (seed := self._readout.joints()) is None:
            return None
        pose, before = self._scene.goal_pose, self._checked
        if before is not None and before[0] == pose and (before[2] or now - before[1] < MARKER_DEBOUNCE):
            return None
        target = pose_to_matrix(pose)
        if before is None or before[0] != pose:
            reachable = solve_ik(self._robot, target, seed, restarts=IK_RESTARTS) is not None
            self._scene.set_goal_reachable(reachable)
            self._checked = (pose, now, reachable)
            return ("Goal marker: reachable. Press Plan to check for collisions.", "good") if reachable else (
                "Goal marker: not reachable.", "bad")
        self._checked = (pose, before[1], True)
        return f"Goal marker: not reachable: {explain_ik_failure(self._robot, target, seed)}", "bad"

    def copy_current(self) -> None:
        """Set the numbers to the current pose of the arm."""
        q = self._readout.joints()
        if q is None:
            self._report("The joint positions are unknown.", "bad")
            return
        self._on_change()
        self._xyz, self._rpy, self._q = self._readout.convert(q)
        assign(self._position, self._xyz)
        assign(self._rotation, self._rpy)
        for field, value in zip(self._angles, self._q, strict=True):
            assign(field, value)

    def _set_kind(self, kind: str) -> None:
        self.kind = kind
        self._on_change()
        self._checkbox.visible = kind == MARKER
        self._position.visible = self._rotation.visible = kind == TOOL
        for field in self._angles:
            field.visible = kind == JOINTS
        if self.numeric:
            self.copy_current()
        elif kind == MARKER and not self.marker:
            self.set_marker(True)

    def _set_xyz(self, xyz: Numbers) -> None:
        self._xyz = xyz
        self._on_change()

    def _set_rpy(self, rpy: Numbers) -> None:
        self._rpy = rpy
        self._on_change()

    def _joint_setter(self, number: int) -> Callable[[float], None]:
        def set_joint(value: float) -> None:
            self._q[number] = value
            self._on_change()

        return set_joint
