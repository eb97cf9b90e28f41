"""The end of an arm: its flange, and a gripper found in the joints beyond the wrist."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.robot.model import RobotModel
from common.robot.transforms import invert
from tools.robot_setup.finger_travel import CONTACT, WIDEST, Couplings, Travel
from tools.robot_setup.fingers import PARALLEL, Grip, check_jaw, check_tool_frame, measure_jaw
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
    travel: list[list[float]] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)


def find_gripper(
    robot: RobotModel, tree: Tree, fingers: Sequence[Joint], points: dict[str, Array]
) -> GripperProposal | str:
    """Return the gripper that joints form, or why the platform cannot drive it.

    One joint is driven and the others follow: by `mimic` of the URDF, or as a pair of equal fingers. The shapes show
    where they are closed. What neither slides nor moves on parallelograms gets a table of measured positions. An
    independent joint that carries none of the coupled fingers is locked.
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
    low, high = max(driven.lower or 0.0, -WIDEST), min(driven.upper or 0.0, WIDEST)
    if not low < high:
        return f"{driven.name} runs from {low:g} to {high:g}: it does not move"
    pair = Couplings([joint.name for joint in order], [factors.get(joint.name, 1.0) for joint in order],
                     [joint.offset if joint.mimic else 0.0 for joint in order])
    found = pair.measured(robot, _palm(tree, order), points, np.linspace(low, high, STEPS))
    if len(factors) < len(order):  # two independent fingers: their shapes show which way the other one moves
        opposite = Couplings(pair.joints, [1.0, -1.0], pair.offsets)
        other = opposite.measured(robot, _palm(tree, order), points, np.linspace(low, high, STEPS))
        if found is None or (other is not None and other[0].widths[-1] > found[0].widths[-1]):
            pair, found = opposite, other
    if found is None:
        return f"no two links that {', '.join(names)} move approach each other"
    grip, at = found
    slides = driven.kind == "prismatic"
    gripper = GripperProposal(
        _palm(tree, order), pair.joints, pair.factors, None, [_palm(tree, order), *grip.pads], round(2 * high, 4),
        round(min(2 * (driven.velocity or SPEED / 2), 0.2), 4), grip)
    if locked:
        gripper.remarks.append(f"gripper: {', '.join(locked)} is locked: it moves independently of {driven.name}")
    if not any(pair.offsets) and grip.turned <= PARALLEL:
        meet = grip.widths[0] <= CONTACT
        if slides and meet and at[0] < at[-1] and {abs(factor) for factor in pair.factors} == {1.0}:
            return _slides(gripper, low, high)
        if not slides and at[0] > at[-1] and abs(low) < 1e-6:
            linked = _with_linkage(gripper, driven, at)
            if not isinstance(linked, str):
                return linked
    return _with_travel(gripper, driven, pair.travel(robot, gripper.palm, points, at))


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
    if abs(low) > 1e-6 or abs(gripper.grip.widths[0]) > CONTACT:  # the shapes show where the fingers touch
        gripper.closed = round(low - gripper.grip.widths[0] / 2, 5)
        gripper.max_width = round(2 * (high - gripper.closed), 4)
    return gripper


def _with_travel(gripper: GripperProposal, driven: Joint, found: Travel | str) -> GripperProposal | str:
    """Add a table of widths and joint positions."""
    if isinstance(found, str):
        return found
    grip = found.grip  # a tip that turns may be farther out between open and closed
    gripper.grip = replace(grip, middle=grip.middle + (max(grip.heights) - grip.heights[0]) * grip.approach)
    gripper.travel, gripper.links = found.rows, [gripper.palm, *grip.pads]
    gripper.max_width = found.rows[-1][0]
    moved = abs(found.rows[-1][1] - found.rows[0][1])
    slowest = driven.velocity or (SPEED / 2 if driven.kind == "prismatic" else 0.5)
    gripper.speed = round(min(gripper.max_width / moved * slowest, 0.2), 4)
    if found.grip.turned > PARALLEL:
        gripper.remarks.append(f"gripper.travel: the pads turn by {math.degrees(found.grip.turned):.0f} degrees while "
                               "they close: they hold an object at their tips only")
    if found.rows[0][0] > CONTACT:
        gripper.remarks.append(f"gripper.travel: closed fingers are {1e3 * found.rows[0][0]:.0f} mm apart: they hold "
                               "nothing narrower")
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
    if gripper.travel:
        values = {"joints": gripper.joints, "travel": gripper.travel}
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
