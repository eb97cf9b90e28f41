"""Mass of the tool as the robot's description gives it."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from common.robot.link_shapes import pose_of_origin
from common.robot.model import RobotModel
from common.robot.transforms import invert


def described_tool(robot: RobotModel) -> tuple[float, NDArray[np.float64]] | None:
    """Return mass [kg] and centre of mass (3,) from the flange [m] of all links beyond the flange.

    None: the description has shapes beyond the flange without a mass.
    """
    poses = robot.link_poses(robot.named("home"))
    T_flange_world = invert(poses[robot.flange_link])
    mass, moment = 0.0, np.zeros(3)
    for link in ET.fromstring(robot.urdf).findall("link"):
        name = str(link.get("name"))
        if not _is_beyond(robot, name):
            continue
        inertial = link.find("inertial")
        element = None if inertial is None else inertial.find("mass")
        own = 0.0 if element is None else float(element.get("value", 0.0))
        if own <= 0.0 or inertial is None:
            if link.find("collision") is not None or link.find("visual") is not None:
                return None
            continue
        T = T_flange_world @ poses[name] @ pose_of_origin(inertial.find("origin"))
        mass, moment = mass + own, moment + own * T[:3, 3]
    return mass, moment / mass if mass else moment


def _is_beyond(robot: RobotModel, link: str) -> bool:
    while (link := robot.link_parents.get(link, "")):
        if link == robot.flange_link:
            return True
    return False
