"""Where an arm ends, and which way is out of its tool."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.robot.model import RobotModel
from common.robot.transforms import invert
from tools.robot_setup.tree import Arm, Tree

Array = NDArray[np.float64]


def out_of(robot: RobotModel, arm: Arm, links: Sequence[str]) -> Array:
    """(3,) unit vector out of the tool, in the frame of the wrist: along the last joint, away from the arm.

    Which way that is say the links at the end, seen from the joints before: the first from which they are off.
    """
    q = (robot.lower + robot.upper) / 2
    poses = robot.link_poses(q)
    T_world_wrist = poses[arm.wrist]
    column = robot.joint_names.index(arm.joints[-1].name)
    jacobian = robot.jacobian(q)[:, column]
    turning = float(np.linalg.norm(jacobian[3:])) > 0.5
    axis = T_world_wrist[:3, :3].T @ (jacobian[3:] if turning else jacobian[:3])
    axis = axis / np.linalg.norm(axis)
    ends = [invert(T_world_wrist) @ poses[link] for link in links]
    for joint in (arm.joints[-1], *arm.joints[-2::-1]):
        start = (invert(T_world_wrist) @ poses[joint.child])[:3, 3]
        offsets = [float((end[:3, 3] - start) @ axis) for end in ends]
        farthest = max(offsets, key=abs)
        if abs(farthest) > 1e-3:
            return np.asarray(axis * np.sign(farthest))
    return np.asarray(axis)


def flange_links(tree: Tree, arm: Arm) -> list[str]:
    """Links at the end of the arm that may be its flange: those without shapes, where there are some."""
    rigid = tree.rigid_with(arm.wrist)
    return [link for link in rigid[1:] if link not in tree.shaped] or rigid


def find_flange(robot: RobotModel, tree: Tree, arm: Arm, tip: str | None) -> tuple[str, Array]:
    """The link that a tool is mounted on, and out of the tool (3,) in its frame: `tip`, or the outermost.

    Of several at one place the one whose z axis points out.
    """
    links = flange_links(tree, arm)
    poses = robot.link_poses((robot.lower + robot.upper) / 2)
    out = poses[arm.wrist][:3, :3] @ out_of(robot, arm, links)
    if tip is None:
        tip = max(links, key=lambda link: (
            round(float(poses[link][:3, 3] @ out), 2), round(float(poses[link][:3, 2] @ out), 2)))
    return tip, np.asarray(poses[tip][:3, :3].T @ out)


def rotation_between(one: Array, other: Array) -> Array:
    """(3, 3) the shortest rotation that takes a unit vector to another, of several any."""
    axis, cosine = np.cross(one, other), float(one @ other)
    if np.linalg.norm(axis) < 1e-6:
        if cosine > 0:
            return np.eye(3)
        across = np.cross(one, np.eye(3)[int(np.argmin(np.abs(one)))])
        across = across / np.linalg.norm(across)
        return np.asarray(2 * np.outer(across, across) - np.eye(3))
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
