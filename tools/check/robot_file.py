"""Checks a robot file against its description, read as text: takes milliseconds and loads no model.

`RobotModel` itself checks joints, locked_joints, tcp_link, base_link and the limits of named poses.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator

from common.config import GripperConfig, RobotConfig
from common.robot.finger_joints import driven_position
from common.robot.urdf import merged_urdf
from tools.check import Finding, error, warning

TURNS, SLIDES = ("revolute", "continuous"), ("prismatic",)  # joint types
SLACK = 1e-3  # [m] or [rad] by which a finger position may exceed its limit: both files have rounded numbers


def check_robot_file(config: RobotConfig) -> Iterator[Finding]:
    """Yield contradictions between a robot file and its description.

    Raises:
        ConfigError: the description does not exist, or cannot be parsed.
    """
    gripper = config.gripper
    if gripper is None:
        return
    robot = ET.fromstring(merged_urdf(config))
    links = [link.get("name", "") for link in robot.findall("link")]
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    for name in gripper.links:
        if name not in links:
            yield error(f"robot.gripper.links: {name!r} is no link of the description, so that the fingers may not "
                        "touch what they take", f"name links among {', '.join(links)}", refused=True)
    moving = [name for name, joint in joints.items() if joint.get("type") in (*TURNS, *SLIDES)]
    for number, name in enumerate(gripper.joints):
        if name not in moving:
            yield error(f"robot.gripper.joints: {name!r} is no joint of the description that moves",
                        f"name joints among {', '.join(moving)}", refused=True)
        elif name in config.joints:
            yield error(f"robot.gripper.joints: {name!r} is one of robot.joints, too: the arm would move as the "
                        "fingers close", "leave it in one of the two", refused=True)
        else:
            yield from _opening(gripper, number, joints[name])


def _opening(gripper: GripperConfig, number: int, joint: ET.Element) -> Iterator[Finding]:
    """Check that a finger's joint fits the conversion of widths to its positions."""
    name, turns = gripper.joints[number], joint.get("type") in TURNS
    angles = "linkage" if gripper.linkage is not None else "jaw" if gripper.jaw is not None else ""
    if turns and not angles and number == 0:
        yield error(f"robot.gripper.joints: {name!r} turns ({joint.get('type')}), but without gripper.linkage half of "
                    "the width [m] is taken for its position [rad]", "give gripper.linkage: length, open_angle and "
                    "closed; or gripper.jaw, where the other finger is fixed", refused=True)
        return
    if not turns and angles and number == 0:
        yield error(f"robot.gripper.joints: {name!r} slides ({joint.get('type')}), but gripper.{angles} gives angles "
                    "for it", f"leave gripper.{angles} out", refused=True)
        return
    if turns and not angles:
        return
    limit, factor = joint.find("limit"), gripper.mimic[number] if gripper.mimic else 1.0
    if limit is None or joint.get("type") == "continuous":
        return
    low, high = (float(limit.get(side, "nan")) for side in ("lower", "upper"))
    unit = "rad" if turns else "m"
    ends = [factor * driven_position(gripper, width) for width in (0.0, gripper.max_width)]
    if not (math.isnan(low) or math.isnan(high)) and (min(ends) < low - SLACK or max(ends) > high + SLACK):
        yield warning(f"robot.gripper: {name!r} would go from {min(ends):g} to {max(ends):g} {unit} between closed and "
                      f"open, its limits are {low:g} to {high:g}",
                      f"correct gripper.max_width, gripper.{angles or 'closed'} or gripper.mimic")
