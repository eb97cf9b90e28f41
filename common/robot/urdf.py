"""The robot's description: find its files, and merge arm, attachments, tool and base pose into one URDF."""

from __future__ import annotations

import functools
import importlib.util
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

from common.config import AttachmentConfig, RobotConfig, config_root
from common.errors import ConfigError

SCHEME = "package://"
WORLD = "world"
FULL_TURN = 2 * math.pi  # [rad]

Numbers = Sequence[float]


@functools.cache
def installed_share() -> Path | None:
    """Return the share/ folder of description packages from PyPI (cmeel wheels), next to pinocchio; None if missing."""
    spec = importlib.util.find_spec("pinocchio")
    if spec is None or spec.origin is None:
        return None
    for parent in Path(spec.origin).resolve().parents:
        if parent.name == "cmeel.prefix":
            return parent / "share"
    return None


def package_folders(configured: Sequence[str]) -> list[Path]:
    """Return the folders that are searched for package://, in order."""
    folders = [Path(folder).expanduser() for folder in configured]
    share = installed_share()
    return [*folders, share] if share else folders


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
        folders = package_folders(configured)
        advice = f"install its package (pip install {inside.partition('/')[0]}) or set robot.package_dirs"
    else:
        inside = str(Path(reference).expanduser())
        folders = [Path(), config_root() / "robots"]
        advice = "give a path that exists or package://<package>/<file>"
    for folder in folders:
        path = folder / inside
        if path.is_file():
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
    for joint in robot.findall("joint"):
        if joint.get("type") == "continuous":
            _limit_continuous(joint)
        elif joint.get("type") == "fixed" and joint.get("name") in links:  # both frames would have the same name
            joint.set("name", f"{joint.get('name')}_fixed")
    ET.SubElement(robot, "link", name=WORLD)
    _fix(robot, config.base_link, WORLD, config.base_position, config.base_rpy)
    return ET.tostring(robot, encoding="unicode")


def read_urdf(field: str, reference: str, package_dirs: Sequence[str]) -> ET.Element:
    """Return the elements of a URDF with absolute instead of relative mesh paths.

    Raises:
        ConfigError: it is missing or does not parse; names the field.
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


def _require_link(robot: ET.Element, field: str, link: str) -> None:
    if link not in _links(robot):
        raise ConfigError(field, link, f"is not a link; choices: {', '.join(_links(robot))}")


def _end(joint: ET.Element, which: str) -> str:
    """Return a joint's parent or child link."""
    found = joint.find(which)
    return found.get("link", "") if found is not None else ""


def _drop_above(robot: ET.Element, config: RobotConfig) -> None:
    """Make base_link the root."""
    _require_link(robot, "robot.base_link", config.base_link)
    link = config.base_link
    while (joint := next((j for j in robot.findall("joint") if _end(j, "child") == link), None)) is not None:
        link = _end(joint, "parent")
        robot.remove(joint)
        siblings = [_end(j, "child") for j in robot.findall("joint") if _end(j, "parent") == link]
        if joint.get("type") != "fixed" or siblings:
            others = f"with another child {siblings[0]}" if siblings else f"and joint {joint.get('name')} moves"
            raise ConfigError("robot.base_link", config.base_link, f"cannot be the root: its parent is {link} {others}")
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
