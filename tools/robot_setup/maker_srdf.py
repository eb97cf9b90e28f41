"""The SRDF of an arm's maker: planning groups, named poses, and pairs of links without collision checks."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from common.errors import ConfigError, UnknownName
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from tools.robot_setup.fingers import ALIGNED
from tools.robot_setup.sampling import hits
from tools.robot_setup.tree import LEAST_JOINTS, Tree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MakerSrdf:
    """Content of an SRDF that fits a URDF.

    Attributes:
        arms: joints of the groups that are one chain of moving joints, by name, in the order of the file.
        poses: joint positions by pose name, by group.
        pairs: links that the maker does not check against each other.
        unknown: links of pairs that the URDF lacks.
    """

    arms: dict[str, list[str]] = field(default_factory=dict)
    poses: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    pairs: list[tuple[str, str]] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)

    def arm(self, group: str) -> str:
        """Return the name of the arm's group: the given one, or the first.

        Raises:
            UnknownName, ConfigError: no such group, or none.
        """
        if group and group not in self.arms:
            raise UnknownName("--group", group, self.arms)
        if not self.arms:
            raise ConfigError("--srdf", ..., f"has no group that is a chain of {LEAST_JOINTS} joints or more")
        return group or next(iter(self.arms))

    def notes(self, group: str) -> list[str]:
        """Return lines about what was used, for the user."""
        others = [name for name in self.arms if name != group]
        chosen = [f"group {group} of the SRDF is the arm; --group selects {', '.join(others)}"] if others else []
        lacking = list(dict.fromkeys(self.unknown))
        more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        return [*chosen, *([f"the SRDF names links that the URDF lacks: {lacking[0]}{more}"] if lacking else [])]

    def arm_poses(self, group: str) -> dict[str, list[float]]:
        """Return the named poses of a group that state each of its joints."""
        joints = self.arms.get(group, [])
        return {name: [pose[joint] for joint in joints] for name, pose in self.poses.get(group, {}).items()
                if set(joints) <= set(pose)}


def read_srdf(root: ET.Element, tree: Tree) -> MakerSrdf:
    """Return what an SRDF states about the links and joints of a URDF."""
    groups = {element.get("name", ""): element for element in root.findall("group")}
    found = MakerSrdf()
    for name in groups:
        joints = [joint.name for joint in tree.joints if joint.moves and joint.mimic is None
                  and joint.name in _joints(groups, name, tree, ())]
        above = [joint.name for joint in tree.above(_child(tree, joints[-1]))] if joints else []
        if len(joints) >= LEAST_JOINTS and set(joints) <= set(above):
            found.arms[name] = sorted(joints, key=above.index)
    for state in root.findall("group_state"):
        pose = {joint.get("name", ""): _number(joint, state) for joint in state.findall("joint")}
        found.poses.setdefault(state.get("group", ""), {})[state.get("name", "")] = pose
    for pair in root.findall("disable_collisions"):
        links = pair.get("link1", ""), pair.get("link2", "")
        if missing := [link for link in links if link not in tree.links]:
            found.unknown.extend(missing)
        else:
            found.pairs.append(links)
    return found


def _joints(groups: dict[str, ET.Element], name: str, tree: Tree, outer: Sequence[str]) -> set[str]:
    """Return all joints of a group, also of groups in it."""
    if name not in groups or name in outer:
        return set()
    found = {each.get("name", "") for each in groups[name].findall("joint")}
    links = {each.get("name", "") for each in groups[name].findall("link")}
    found |= {joint.name for joint in tree.joints if joint.child in links}
    for chain in groups[name].findall("chain"):
        base = {joint.name for joint in tree.above(chain.get("base_link", ""))}
        found |= {joint.name for joint in tree.above(chain.get("tip_link", ""))} - base
    for inner in groups[name].findall("group"):
        found |= _joints(groups, inner.get("name", ""), tree, (*outer, name))
    return found


def _child(tree: Tree, joint: str) -> str:
    return next(each.child for each in tree.joints if each.name == joint)


def _number(joint: ET.Element, state: ET.Element) -> float:
    text = joint.get("value", "")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError("--srdf", text, f"is the position of {joint.get('name')} in {state.get('name')}, no number")
    return value


def fitting_poses(
    robot: RobotModel, geometry: RobotGeometry, poses: Mapping[str, Sequence[float]]
) -> tuple[dict[str, Array], list[str]]:
    """Return the poses that are within the limits, and remarks; a home that does not suit tasks is renamed."""
    found: dict[str, Array] = {}
    remarks = []
    for name, positions in poses.items():
        q = np.array(positions, dtype=float)
        if not robot.within_limits(q, tolerance=0.01):
            remarks.append(f"pose {name} of the SRDF is left out: it exceeds the position limits")
            continue
        q = np.clip(q, robot.lower, robot.upper)
        touching, down = hits(robot, geometry, q), float(robot.fk(q)[2, 2]) < -ALIGNED
        remarks += [f"pose {name} of the SRDF: {touching[0]} touch"] if touching else []
        if name == "home" and (touching or not down):
            remarks.append("pose home of the SRDF is saved as maker_home: tasks need one with the tool down")
        found["maker_home" if name == "home" and (touching or not down) else name] = q
    return found, remarks
