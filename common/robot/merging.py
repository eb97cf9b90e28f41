"""One URDF from several: the arm, what is mounted on it, its tool centre point, and where it stands."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from common.config import AttachmentConfig, RobotConfig
from common.errors import ConfigError
from common.robot.description import find_description

WORLD = "world"
FULL_TURN = 2 * math.pi  # [rad]

Numbers = Sequence[float]


def merged_urdf(config: RobotConfig) -> str:
    """The robot as one URDF whose root is a link `world`, with `base_link` fixed to it where the robot file says.

    What a URDF has above `base_link` is dropped: it says where the robot stands, which is the robot file's to say.
    Meshes that are given by relative paths lie beside the URDF that names them. Joints that turn on and on end after a
    full turn either way, or where `position_limits` of the robot file say.

    Raises:
        ConfigError: a description is not there or does not parse, or the parts do not fit together.
    """
    robot = read_urdf("robot.urdf", config.urdf, config.package_dirs)
    _drop_above(robot, config)
    for index, attachment in enumerate(config.attachments):
        _attach(robot, attachment, f"robot.attachments.{index}", config.package_dirs)
    if config.tcp is not None:
        tcp = config.tcp
        _known(robot, "robot.tcp.parent", tcp.parent)
        if tcp.link in _links(robot):
            raise ConfigError("robot.tcp.link", tcp.link, "is a link of the URDF already; give tcp_link instead")
        _fix(robot, tcp.link, tcp.parent, tcp.position, tcp.rpy)
        ET.SubElement(robot, "link", name=tcp.link)
    links = _links(robot)
    for joint in robot.findall("joint"):
        if joint.get("type") == "continuous":
            _give_ends(joint)
        elif joint.get("type") == "fixed" and joint.get("name") in links:  # frames of both would have one name
            joint.set("name", f"{joint.get('name')}_fixed")
    ET.SubElement(robot, "link", name=WORLD)
    _fix(robot, config.base_link, WORLD, config.base_position, config.base_rpy)
    return ET.tostring(robot, encoding="unicode")


def read_urdf(field: str, reference: str, package_dirs: Sequence[str]) -> ET.Element:
    """The elements of a URDF, whose meshes are given by absolute paths where they were relative ones.

    Raises:
        ConfigError: it is not there or does not parse; names the field.
    """
    path = find_description(field, reference, package_dirs)
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, OSError) as error:
        raise ConfigError(field, str(path), f"does not parse: {error}") from None
    if root.tag != "robot":
        raise ConfigError(field, str(path), f"does not parse: its root is <{root.tag}>, not <robot>")
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if name and "://" not in name and not Path(name).is_absolute():
            mesh.set("filename", str(path.parent / name))
    return root


def _links(robot: ET.Element) -> list[str]:
    return [link.get("name", "") for link in robot.findall("link")]


def _known(robot: ET.Element, field: str, link: str) -> None:
    if link not in _links(robot):
        raise ConfigError(field, link, f"is not a link; choices: {', '.join(_links(robot))}")


def _end(joint: ET.Element, which: str) -> str:
    """The link that is a joint's parent or child."""
    found = joint.find(which)
    return found.get("link", "") if found is not None else ""


def _drop_above(robot: ET.Element, config: RobotConfig) -> None:
    """Make base_link the root."""
    _known(robot, "robot.base_link", config.base_link)
    link = config.base_link
    while (joint := next((j for j in robot.findall("joint") if _end(j, "child") == link), None)) is not None:
        link = _end(joint, "parent")
        robot.remove(joint)
        beside = [_end(j, "child") for j in robot.findall("joint") if _end(j, "parent") == link]
        if joint.get("type") != "fixed" or beside:
            others = f"which carries {beside[0]} too" if beside else f"by joint {joint.get('name')}, which moves"
            raise ConfigError("robot.base_link", config.base_link, f"is no root: it hangs on {link}, {others}")
        robot.remove(next(element for element in robot.findall("link") if element.get("name") == link))


def _give_ends(joint: ET.Element) -> None:
    """Make a joint that turns on and on one with ends, a full turn either way: joints have one position each."""
    joint.set("type", "revolute")
    limit = joint.find("limit")
    limit = ET.SubElement(joint, "limit", effort="0", velocity="0") if limit is None else limit
    limit.set("lower", _text([-FULL_TURN]))
    limit.set("upper", _text([FULL_TURN]))


def _attach(robot: ET.Element, attachment: AttachmentConfig, field: str, package_dirs: Sequence[str]) -> None:
    part = read_urdf(f"{field}.urdf", attachment.urdf, package_dirs)
    _known(robot, f"{field}.parent_link", attachment.parent_link)
    for tag in ("link", "joint"):
        names = {element.get("name") for element in robot.findall(tag)}
        twice = next((e.get("name") for e in part.findall(tag) if e.get("name") in names), None)
        if twice is not None:
            raise ConfigError(f"{field}.urdf", attachment.urdf, f"has a {tag} {twice}, which the robot has already")
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
