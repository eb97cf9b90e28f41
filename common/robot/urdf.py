"""The robot's description: find its files, and merge arm, attachments, tool and base pose into one URDF."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from common.config import AttachmentConfig, RobotConfig, config_root
from common.errors import ConfigError
from common.robot.description_file import read_xml
from common.robot.link_shapes import link_shapes, pose_of_origin
from common.robot.mesh_references import SCHEME, resolve_meshes
from common.robot.packages import package_folders, package_paths
from common.robot.transforms import invert, matrix_to_rpy

WORLD = "world"
FULL_TURN = 2 * math.pi  # [rad]

Numbers = Sequence[float]


def find_description(field: str, reference: str, configured: Sequence[str] = ()) -> Path:
    """Return the file of a path or a package:// reference.

    Args:
        field: name of the value in the configuration, for the error.
        reference: package://<package>/..., an absolute path, or one relative to the working or config/robots folder.
        configured: folders that are searched before the installed packages.

    Raises:
        ConfigError: names the file, the searched folders and what to install.
    """
    if reference.startswith(SCHEME):
        inside = reference.removeprefix(SCHEME)
        name, _, rest = inside.partition("/")
        folders, paths = package_folders(configured), (folder / rest for folder in package_paths(name, configured))
        advice = f"install its package (pip install {name}) or set robot.package_dirs"
    else:
        inside = str(Path(reference).expanduser())
        folders = [Path(), config_root() / "robots"]
        paths = (folder / inside for folder in folders)
        advice = "give a path that exists or package://<package>/<file>"
    if (path := next((each for each in paths if each.is_file()), None)) is not None:
        return path.resolve()
    searched = ", ".join(str(folder) for folder in folders) or "nowhere"
    raise ConfigError(field, reference, f"is missing (searched {searched}); {advice}")


def merged_urdf(config: RobotConfig) -> str:
    """Return the robot as one URDF whose root is a link `world`, with `base_link` fixed to it as in the robot file.

    Links of a URDF above `base_link` are dropped: the robot file defines the base pose. Relative mesh paths start at
    the URDF that names them. Continuous joints end after a full turn either way, or at `position_limits` of the file.

    Raises:
        ConfigError: a description is missing or does not parse, or the parts do not fit together.
    """
    robot = read_urdf("robot.urdf", config.urdf, config.package_dirs)
    _drop_above(robot, config)
    for index, attachment in enumerate(config.attachments):
        _attach(robot, attachment, f"robot.attachments.{index}", config.package_dirs)
    if config.tcp is not None:
        tcp = config.tcp
        _require_link(robot, "robot.tcp.parent", tcp.parent)
        if tcp.link in _links(robot):
            raise ConfigError("robot.tcp.link", tcp.link, "is a link of the URDF already; use tcp_link instead")
        _fix(robot, tcp.link, tcp.parent, tcp.position, tcp.rpy)
        ET.SubElement(robot, "link", name=tcp.link)
    links = _links(robot)
    for name in config.visual_as_collision:
        _require_link(robot, "robot.visual_as_collision", name)
        link = next(link for link in robot.findall("link") if link.get("name") == name)
        for visual in [] if link.find("collision") is not None else link.findall("visual"):
            ET.SubElement(link, "collision").extend([part for part in visual if part.tag != "material"])
    for joint in robot.findall("joint"):
        if joint.get("type") == "continuous":
            _limit_continuous(joint)
        elif joint.get("type") == "fixed" and joint.get("name") in links:  # both frames would have the same name
            joint.set("name", f"{joint.get('name')}_fixed")
    ET.SubElement(robot, "link", name=WORLD)
    _fix(robot, config.base_link, WORLD, config.base_position, config.base_rpy)
    return ET.tostring(robot, encoding="unicode")


def read_urdf(field: str, reference: str, package_dirs: Sequence[str]) -> ET.Element:
    """Return the elements of a URDF with absolute paths of its meshes, without visual ones that are missing.

    Raises:
        ConfigError: it is missing or does not parse, or one of its shapes is incomplete; names the field.
    """
    path = find_description(field, reference, package_dirs)
    root = read_xml(field, path)
    resolve_meshes(root, path, package_dirs)
    for kind in ("collision", "visual"):
        list(link_shapes(root, kind, field, str(path)))  # raises where a shape is incomplete
    return root


def _links(robot: ET.Element) -> list[str]:
    return [link.get("name", "") for link in robot.findall("link")]


def _require_link(robot: ET.Element, field: str, link: str) -> None:
    if link not in _links(robot):
        raise ConfigError(field, link, f"is not a link; choices: {', '.join(_links(robot))}")


def _end(joint: ET.Element, which: str) -> str:
    """Return a joint's parent or child link."""
    found = joint.find(which)
    return found.get("link", "") if found is not None else ""


def _drop_above(robot: ET.Element, config: RobotConfig) -> None:
    """Make base_link the root; what else is on a link that it is fixed to is then fixed to base_link."""
    _require_link(robot, "robot.base_link", config.base_link)
    link, T_base_link = config.base_link, np.eye(4)
    while (joint := next((j for j in robot.findall("joint") if _end(j, "child") == link), None)) is not None:
        link = _end(joint, "parent")
        robot.remove(joint)
        if joint.get("type") != "fixed":
            raise ConfigError("robot.base_link", config.base_link,
                              f"cannot be the root: its parent is {link} and joint {joint.get('name')} moves")
        T_base_link = T_base_link @ invert(pose_of_origin(joint.find("origin")))
        for sibling in [j for j in robot.findall("joint") if _end(j, "parent") == link]:
            T = T_base_link @ pose_of_origin(sibling.find("origin"))
            for part in sibling.findall("parent") + sibling.findall("origin"):
                sibling.remove(part)
            ET.SubElement(sibling, "parent", link=config.base_link)
            ET.SubElement(sibling, "origin", xyz=_text(T[:3, 3].tolist()), rpy=_text(matrix_to_rpy(T[:3, :3])))
        robot.remove(next(element for element in robot.findall("link") if element.get("name") == link))


def _limit_continuous(joint: ET.Element) -> None:
    """Make a continuous joint revolute, with limits of a full turn either way: each joint has one position."""
    joint.set("type", "revolute")
    limit = joint.find("limit")
    limit = ET.SubElement(joint, "limit", effort="0", velocity="0") if limit is None else limit
    limit.set("lower", _text([-FULL_TURN]))
    limit.set("upper", _text([FULL_TURN]))


def _attach(robot: ET.Element, attachment: AttachmentConfig, field: str, package_dirs: Sequence[str]) -> None:
    part = read_urdf(f"{field}.urdf", attachment.urdf, package_dirs)
    _require_link(robot, f"{field}.parent_link", attachment.parent_link)
    for tag in ("link", "joint"):
        names = {element.get("name") for element in robot.findall(tag)}
        twice = next((e.get("name") for e in part.findall(tag) if e.get("name") in names), None)
        if twice is not None:
            raise ConfigError(f"{field}.urdf", attachment.urdf, f"has a {tag} {twice}, which the robot already has")
    children = {_end(joint, "child") for joint in part.findall("joint")}
    roots = [link for link in _links(part) if link not in children]
    if len(roots) != 1:
        raise ConfigError(f"{field}.urdf", attachment.urdf, f"must have one root, not {', '.join(roots) or 'none'}")
    materials = {material.get("name") for material in robot.findall("material")}
    for element in part:
        if not (element.tag == "material" and element.get("name") in materials):
            robot.append(element)
    _fix(robot, roots[0], attachment.parent_link, attachment.position, attachment.rpy)


def _fix(robot: ET.Element, child: str, parent: str, position: Numbers, rpy: Numbers) -> None:
    """Add a fixed joint."""
    joint = ET.SubElement(robot, "joint", name=f"{parent}-{child}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_text(position), rpy=_text(rpy))


def _text(values: Numbers) -> str:
    return " ".join(repr(float(value)) for value in values)
