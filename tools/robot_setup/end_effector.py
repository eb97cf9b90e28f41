"""The end of an arm: its flange, and a gripper found in the joints beyond the wrist."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.robot.model import RobotModel
from common.robot.transforms import invert
from tools.robot_setup.fingers import PARALLEL, Grip, check_jaw, check_tool_frame, links_moved, measure, measure_jaw
from tools.robot_setup.tree import Arm, Joint, Tree

Array = NDArray[np.float64]

STEPS = 9  # positions of the driven joint at which fingers are measured
MISFIT = 0.001  # largest error of the linkage model [m]
SPEED = 0.1  # of the width, if the URDF gives none for the driven joint [m/s]


@dataclass
class GripperProposal:
    """Values of a `gripper` section, and the measured grip in the frame of the palm."""

    palm: str
    joints: list[str]  # the driven one first
    mimic: list[float]
    linkage: dict[str, float] | None
    links: list[str]
    max_width: float
    speed: float
    grip: Grip
    closed: float = 0.0
    jaw: dict[str, float] | None = None
    remarks: list[str] = field(default_factory=list)


def find_gripper(
    robot: RobotModel, tree: Tree, fingers: Sequence[Joint], points: dict[str, Array]
) -> GripperProposal | str:
    """Return the gripper that joints form, or why the platform cannot drive it.

    One joint is driven and the others follow: by `mimic` of the URDF, or as a pair of equal slides. Slides are closed
    at their lower end; fingers on parallelograms are open at 0, and their pads stay parallel. An independent joint
    that carries none of the coupled fingers is locked.
    """
    fingers, locked = _without_others(tree, fingers)
    names = [joint.name for joint in fingers]
    if len(fingers) == 1:
        return _jaw(robot, fingers[0], points)
    driven = next((joint for joint in fingers if any(j.mimic and j.mimic[0] == joint.name for j in fingers)), None)
    free = [joint for joint in fingers if joint.mimic is None]
    if driven is None:
        if len(fingers) != 2:
            return f"its {len(fingers)} joints move independently: {', '.join(names)}"
        driven = fingers[0]
        factors = {driven.name: 1.0}
    else:
        independent = [joint.name for joint in free if joint is not driven]
        if independent:
            return f"{', '.join(independent)} move independently of {driven.name}"
        factors = {driven.name: 1.0} | {joint.name: joint.mimic[1] for joint in fingers if joint.mimic}
    order = [driven, *(joint for joint in fingers if joint is not driven)]
    palm = _palm(tree, order)
    links = links_moved(robot, names)
    low, high = driven.lower or 0.0, driven.upper or 0.0
    if len(factors) < len(order):
        other = order[1]
        sign = 1.0 if abs((other.upper or 0.0) - high) + abs((other.lower or 0.0) - low) < 1e-3 else -1.0
        factors[other.name] = sign
    mimic = [factors[joint.name] for joint in order]
    slides = driven.kind == "prismatic"
    if not low < high or low < -1e-6:
        start = "start at 0 or more" if slides else "start at 0"
        return f"{driven.name} runs from {low:g} to {high:g}; the platform drives joints that {start}"
    travel = np.linspace(low if slides else 0.0, high, STEPS)
    rows = [[factor * float(at) for factor in mimic] for at in (travel if slides else travel[::-1])]
    grip = measure(robot, palm, links, [joint.name for joint in order], rows, points)
    if grip is None:
        return f"no two links that {', '.join(names)} move approach each other"
    if grip.widths[-1] <= grip.widths[0]:
        return (f"the fingers are {'open' if slides else 'closed'} where {driven.name} is 0; the platform takes slides "
                "to be closed there, and linkages to be open")
    if grip.turned > PARALLEL:
        return (f"the pads {' and '.join(grip.pads)} turn by {math.degrees(grip.turned):.0f} degrees while "
                "they close; the platform drives pads that stay parallel")
    gripper = GripperProposal(
        palm, [joint.name for joint in order], mimic, None, [palm, *grip.pads], round(2 * high, 4),
        round(min(2 * (driven.velocity or SPEED / 2), 0.2), 4), grip)
    if locked:
        gripper.remarks.append(f"gripper: {', '.join(locked)} is locked: it moves independently of {driven.name}")
    return _slides(gripper, low, high) if slides else _with_linkage(gripper, driven, travel[::-1])


def check_gripper(robot: RobotModel) -> list[str]:
    """Return deviations of tool frame and fingers from the platform's conventions, one line each."""
    config = robot.config.gripper
    return check_jaw(robot) if config is not None and config.jaw is not None else check_tool_frame(robot)


def _jaw(robot: RobotModel, joint: Joint, points: dict[str, Array]) -> GripperProposal | str:
    """Return the gripper of one turning finger and a fixed one, or why there is none."""
    if joint.kind != "revolute":
        return f"{joint.name} slides one finger against a fixed one; the platform drives jaws that turn, or pairs"
    found = measure_jaw(robot, joint.name, points)
    if isinstance(found, str):
        return found
    if found.max_width < 2 * MISFIT:
        return f"the jaw of {joint.name} opens by {1e3 * found.max_width:.0f} mm only"
    jaw = {"radius": found.radius, "angle": found.angle, "closed": found.closed, "opens": found.opens}
    links = list(dict.fromkeys([found.carrier, *found.grip.pads]))
    speed = round(min(found.radius * 0.5 * (joint.velocity or 0.5), 0.2), 4)
    gripper = GripperProposal(
        found.carrier, [joint.name], [1.0], None, links, found.max_width, speed, found.grip, jaw=jaw)
    gripper.remarks.append(
        "gripper.jaw: one finger is fixed; the tool centre point is in the middle of the open jaws, so that closing on "
        f"an object of W mm moves it and the fixed finger together by ({1e3 * found.max_width:.0f} - W) / 2 mm")
    return gripper


def _without_others(tree: Tree, fingers: Sequence[Joint]) -> tuple[list[Joint], list[str]]:
    """Return the coupled fingers, and the names of joints that carry none of them."""
    followed = {joint.mimic[0] for joint in fingers if joint.mimic}
    if len(followed) != 1:
        return list(fingers), []
    carried = {above.name for joint in fingers if joint.mimic or joint.name in followed
               for above in tree.above(joint.child)}
    locked = [joint.name for joint in fingers if joint.mimic is None and joint.name not in followed | carried]
    return [joint for joint in fingers if joint.name not in locked], locked


def _slides(gripper: GripperProposal, low: float, high: float) -> GripperProposal:
    closed = gripper.grip.widths[0]
    if low > 0:  # the shapes show whether the fingers touch at their lower end
        gripper.closed = round(low - closed / 2, 5)
        gripper.max_width = round(2 * (high - gripper.closed), 4)
        if gripper.closed < low - 1e-4:
            gripper.remarks.append(
                f"gripper.closed: the fingers would meet at {gripper.closed:g}, beyond the end of {gripper.joints[0]}, "
                f"{low:g}")
        return gripper
    if abs(closed) > 0.003:
        gripper.remarks.append(
            f"gripper.max_width: the fingers are {1e3 * closed:.0f} mm apart where the platform assumes contact; held "
            "objects are measured too narrow by that")
    return gripper


def _with_linkage(gripper: GripperProposal, driven: Joint, angles: Array) -> GripperProposal | str:
    """Fit a parallelogram to the measured widths: 2 L (sin(open - a) - sin(open - closed)) at an angle a."""
    grip = gripper.grip
    columns = np.column_stack([np.cos(angles), -np.sin(angles), np.ones(len(angles))])
    (sine, cosine, offset), *_ = np.linalg.lstsq(columns, np.array(grip.widths), rcond=None)
    misfit = float(np.abs(columns @ np.array([sine, cosine, offset]) - grip.widths).max())
    length, opened = math.hypot(sine, cosine) / 2, math.atan2(sine, cosine)
    if misfit > MISFIT or not 0 < length < 1:
        return f"the pads of {driven.name} do not move on a parallelogram, {1e3 * misfit:.1f} mm off"
    reached = -offset / (2 * length)
    if not -1 <= reached <= 1:
        return f"the pads of {driven.name} never meet"
    closed = opened - math.asin(reached)
    if closed > (driven.upper or 0.0) + 0.02:
        gripper.remarks.append(f"gripper.linkage: the pads meet at {closed:.2f} rad, beyond the end of {driven.name}, "
                            f"{driven.upper or 0.0:.2f}")
    linkage = {"length": round(length, 6), "open_angle": round(opened, 6), "closed": round(closed, 6)}
    gripper.linkage = linkage
    gripper.max_width = round(2 * linkage["length"] * (
        math.sin(linkage["open_angle"]) - math.sin(linkage["open_angle"] - linkage["closed"])), 5)
    fastest = 2 * length * max(math.cos(opened - float(angle)) for angle in angles) * (driven.velocity or 0.5)
    gripper.speed = round(min(fastest / 2, 0.2), 4)
    gripper.links = list(grip.pads)
    return gripper


def _palm(tree: Tree, fingers: Sequence[Joint]) -> str:
    """Return the last link that carries all fingers."""
    chains = [[joint.parent for joint in tree.above(finger.child)] for finger in fingers]
    shared = [link for link in chains[0] if all(link in chain for chain in chains)]
    return shared[-1]


def section(gripper: GripperProposal, closing: str) -> dict[str, Any]:
    """Return the `gripper` section of a robot file with a closing axis of the tool frame."""
    values: dict[str, Any] = {"joints": gripper.joints}
    if any(factor != 1 for factor in gripper.mimic):
        values["mimic"] = gripper.mimic
    if gripper.linkage:
        values["linkage"] = gripper.linkage
    if gripper.closed:
        values["closed"] = gripper.closed
    if gripper.jaw:
        values["jaw"] = gripper.jaw
    return values | {
        "links": gripper.links, "max_width": gripper.max_width, "closing_axis": closing, "speed": gripper.speed,
        "fingers": {"depth": round(gripper.grip.depth, 4), "half_width": round(gripper.grip.half_width, 4)},
    }


def out_of(robot: RobotModel, arm: Arm, links: Sequence[str]) -> Array:
    """Return the (3,) unit vector out of the tool in the frame of the wrist: along the last joint, away from the arm.

    The sign follows from the offset of the end links to the nearest joint from which they have one.
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
    """Return links at the end of the arm that may be its flange: those without shapes, if there are any."""
    rigid = tree.rigid_with(arm.wrist)
    return [link for link in rigid[1:] if link not in tree.shaped] or rigid


def find_flange(robot: RobotModel, tree: Tree, arm: Arm, tip: str | None) -> tuple[str, Array]:
    """Return the mounting link, and the direction out of the tool (3,) in its frame: `tip`, or the outermost link.

    Of several links at one position, the one whose z axis points out.
    """
    links = flange_links(tree, arm)
    poses = robot.link_poses((robot.lower + robot.upper) / 2)
    out = poses[arm.wrist][:3, :3] @ out_of(robot, arm, links)
    if tip is None:
        tip = max(links, key=lambda link: (
            round(float(poses[link][:3, 3] @ out), 2), round(float(poses[link][:3, 2] @ out), 2)))
    return tip, np.asarray(poses[tip][:3, :3].T @ out)


def rotation_between(one: Array, other: Array) -> Array:
    """Return the shortest rotation (3, 3) from a unit vector to another; any if there are several."""
    axis, cosine = np.cross(one, other), float(one @ other)
    if np.linalg.norm(axis) < 1e-6:
        if cosine > 0:
            return np.eye(3)
        across = np.cross(one, np.eye(3)[int(np.argmin(np.abs(one)))])
        across = across / np.linalg.norm(across)
        return np.asarray(2 * np.outer(across, across) - np.eye(3))
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
