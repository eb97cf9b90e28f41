"""The marker in the scene that a person pulls to where the tool is to go: it is green where the arm can be there."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import viser

from common.messages import Pose
from common.robot.transforms import invert, matrix_to_pose
from page.nodes import FLAT, matrix_wxyz, pose_from, position_of, wxyz_of

if TYPE_CHECKING:
    from common.robot.model import RobotModel
    from common.robot.visual_meshes import Piece

HAND, REACHED, NOT_REACHED = (255, 170, 60), (60, 200, 100), (240, 60, 60)
_SIZE = 0.18  # of the marker [m]
FARTHEST, ROUNDING = 100.0, 1e-3  # [m] from the origin of world; of the length of a quaternion


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
        self._kept = matrix_to_pose(T_world_tcp)
        hand = _hand(robot)
        self._scene = scene
        self._drawn: list[viser.MeshHandle] = []
        self._colour = HAND
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
        """Where it is, in world; put back where a browser gave it a pose that is none, or is nowhere near."""
        position, wxyz = np.array(self._node.position, float), np.array(self._node.wxyz, float)
        if np.all(np.abs(position) <= FARTHEST) and abs(np.linalg.norm(wxyz) - 1) < ROUNDING:
            self._kept = pose_from(position, wxyz)
        else:
            self.pose = self._kept
        return self._kept

    @pose.setter
    def pose(self, pose: Pose) -> None:
        self._node.position, self._node.wxyz = position_of(pose), wxyz_of(pose)

    def show_reached(self, reached: bool | None) -> None:
        """Be green or red; None: it is not known."""
        colour = HAND if reached is None else REACHED if reached else NOT_REACHED
        if colour != self._colour:
            self._colour = colour
            for node in self._drawn:
                node.color = colour

    def _draw(self) -> None:
        """Send the meshes, once: a browser takes its time over meshes that are hidden, too."""
        for number, (piece, T_tcp_link) in enumerate(self._undrawn):
            self._drawn.append(self._scene.add_mesh_simple(
                f"{self._node.name}/{number}", piece.vertices, piece.faces, color=self._colour, opacity=0.45,
                position=T_tcp_link[:3, 3], wxyz=matrix_wxyz(T_tcp_link), **FLAT,
            ))
        self._undrawn.clear()


def _hand(robot: RobotModel) -> set[str]:
    """Links that hang on the last joint of the arm, with those that hang on them."""
    model = robot.full_model
    last = model.getJointId(robot.joint_names[-1])
    return {f.name for f in model.frames if f.name in robot.link_names and last in list(model.supports[f.parentJoint])}
