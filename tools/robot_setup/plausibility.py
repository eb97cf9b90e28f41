"""What a URDF may say and is probably wrong: links without collision shapes, odd sizes, limits like degrees."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from common.planning.robot_geometry import shape_corners
from common.robot.description_values import FARTHEST
from common.robot.model import RobotModel
from common.robot.urdf import WORLD
from tools.robot_setup.tree import Joint

Array = NDArray[np.float64]

LARGE, SMALL = 3.0, 0.001  # [m] largest side of a link: larger and smaller ones are reported
BEYOND = 3.0  # times the reach of the arm: a link that is LARGE too cannot be right
TURNS = 4 * math.pi + 0.01  # [rad] farthest position of a joint that turns
FASTEST = 30.0  # [rad/s or m/s] a faster joint is not believed
LONGEST = 10.0  # [m] reach of an arm: a longer one is reported
TRAVEL = 10.0  # [m] farthest position of a joint that slides


def bare_links(robot: RobotModel) -> list[str]:
    """Return links that are visible and collide with nothing.

    Not those with a fixed child that only collides: descriptions have such links for coarse shapes.
    """
    root = ET.fromstring(robot.urdf)
    kinds = {str(link.get("name")): {part.tag for part in link} & {"visual", "collision"} for link in root.iter("link")}
    coarse = {joint.find("parent").get("link") for joint in root.findall("joint")  # type: ignore[union-attr]
              if joint.get("type") == "fixed" and kinds.get(_child(joint)) == {"collision"}}
    return [link for link, found in kinds.items() if found == {"visual"} and link != WORLD and link not in coarse]


def _child(joint: ET.Element) -> str:
    child = joint.find("child")
    return "" if child is None else str(child.get("link"))


def led_joints(robot: RobotModel) -> dict[str, str]:
    """Return locked joints that follow a joint of the arm by `mimic`, and the joint that they follow."""
    follows = {str(joint.get("name")): str(mimic.get("joint")) for joint in ET.fromstring(robot.urdf).findall("joint")
               if (mimic := joint.find("mimic")) is not None}
    return {name: leader for name, leader in follows.items() if leader in robot.joint_names}


def odd_sizes(robot: RobotModel) -> list[tuple[str, bool]]:
    """Return a line for a long arm and each large or small link by its shapes, and whether it cannot be right."""
    corners: dict[str, list[Array]] = {}
    for item in robot.full_geometry().geometryObjects:
        frame = robot.full_model.frames[item.parentFrame]
        corners.setdefault(frame.name, []).append(shape_corners(item.geometry, frame.placement.actInv(item.placement)))
    found = []
    if robot.reach > LONGEST:
        found.append((f"the arm reaches {robot.reach:.3g} m: its lengths look like millimetres, and must be m",
                      robot.reach > FARTHEST))
    for link, parts in corners.items():
        sides = np.ptp(np.concatenate(parts), axis=0)
        shown = " x ".join(f"{side:.3g}" for side in sides)
        if sides.max() > LARGE:
            found.append((f"link {link} is {shown} m large, and the arm reaches {robot.reach:.3g} m: check the unit "
                          "and scale of its meshes", bool(sides.max() > BEYOND * robot.reach)))
        elif sides.max() < SMALL:
            found.append((f"link {link} is {shown} m small: check the unit and scale of its meshes", True))
    return found


def odd_limits(joints: Iterable[Joint]) -> list[str]:
    """Return a line for each joint whose limits look like degrees or millimetres."""
    found = []
    for joint in joints:
        turns, ends = joint.kind != "prismatic", (joint.lower or 0.0, joint.upper or 0.0)
        unit = "degrees, and must be rad" if turns else "millimetres, and must be m"
        if max(map(abs, ends)) > (TURNS if turns else TRAVEL):
            found.append(f"limits of {joint.name}, {ends[0]:g} to {ends[1]:g}, look like {unit}")
        if (joint.velocity or 0.0) > FASTEST:
            found.append(f"velocity limit of {joint.name}, {joint.velocity:g}, looks like {unit}/s")
    return found


def doubts(robot: RobotModel, joints: Sequence[Joint]) -> list[str]:
    """Return a line for each doubt about a description that a new robot file should state."""
    led = [f"locked_joints: {name} follows {leader} of the arm, but its link is checked where it is locked only"
           for name, leader in led_joints(robot).items()]
    return [*odd_limits(joints), *(line for line, _ in odd_sizes(robot)), *led]


UNCHECKED = {"Always": "they touch in all poses, or in almost all with one or two joints between them",
             "Hulls": "their convex hulls touch in almost all poses, their shapes in none"}


def unchecked(robot: RobotModel) -> list[str]:
    """Return a line for each pair of links that is not checked although it may touch, from SRDF and robot file."""
    items = ET.parse(robot.srdf).iter("disable_collisions") if robot.srdf else []
    lines = [f"{item.get('link1')} and {item.get('link2')}: {UNCHECKED[reason]}" for item in items
             if (reason := str(item.get("reason"))) in UNCHECKED]
    return lines + [f"{one} and {other}: allowed_pairs" for one, other in robot.config.allowed_pairs]


def findings(robot: RobotModel) -> tuple[list[str], list[str]]:
    """Return faults of a robot file, and notes that are none, one line each."""
    sizes, bare = odd_sizes(robot), bare_links(robot)
    notes = [f"check: {line}" for line, impossible in sizes if not impossible]
    notes += [f"not checked: {line}" for line in unchecked(robot)]
    if bare:
        shown = ", ".join(bare)
        notes.append(f"check: links with a visual and no collision shape: {shown}; visual_as_collision adds them")
    return [line for line, impossible in sizes if impossible], notes
