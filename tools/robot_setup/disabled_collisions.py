"""Pairs of links that need no collision check: found by sampling, written as an SRDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.robot_geometry import convex_hulls
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel

Array = NDArray[np.float64]
Reason = Literal["Adjacent", "Fixed", "Always", "Never"]

ALMOST_ALWAYS = 0.95  # of the samples


@dataclass(frozen=True)
class DisabledPair:
    """Two links that are not checked, and why.

    Adjacent: a joint connects them. Fixed: no joint of the group moves one against the other. Always: they touch at
    every sample; on both sides of one joint at almost every sample, as overlapping hulls of a wrist do. Never: they
    came no closer than the margin at any sample.
    """

    one: str
    other: str
    reason: Reason


def disabled_pairs(
    robot: RobotModel, *, samples: int = 10000, margin: float = 0.005, rng: np.random.Generator | None = None
) -> list[DisabledPair]:
    """Return pairs of links that need no check, in the order of the description; ignores the robot's own SRDF.

    Args:
        robot: the model; its group is sampled uniformly within the limits, its fingers over their widths.
        samples: more of them make it more certain that a pair which never came close never will.
        margin: pairs that come closer than this [m] at some sample are not reported as Never.
        rng: source of the samples; without it they are the same each time.
    """
    geometry = convex_hulls(robot.full_geometry(pin.GeometryType.COLLISION))
    model = robot.full_model
    names = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    links = list(dict.fromkeys(names))
    bodies = {name: robot.model.frames[robot.model.getFrameId(name)].parentJoint for name in links}
    found: dict[tuple[str, str], Reason] = {}
    for i, one in enumerate(links):
        for other in links[i + 1:]:
            if bodies[one] == bodies[other]:
                found[one, other] = "Fixed"
            elif _carrier(robot, other, links) == one or _carrier(robot, one, links) == other:
                found[one, other] = "Adjacent"
    for i, one in enumerate(names):
        for j in range(i + 1, len(names)):
            if one != names[j] and (one, names[j]) not in found:
                geometry.addCollisionPair(pin.CollisionPair(i, j))
    between = [(names[pair.first], names[pair.second]) for pair in geometry.collisionPairs]
    generator = rng if rng is not None else np.random.default_rng(0)
    configurations = sample_configurations(robot, samples, generator)
    close = _hits(model, geometry, configurations, margin)

    def least(pair: tuple[str, str]) -> float:
        """Return the share of samples at which a pair must touch to be reported as Always."""
        one, other = (bodies[link] for link in pair)
        return ALMOST_ALWAYS if robot.model.parents[one] == other or robot.model.parents[other] == one else 1.0

    columns = {pair: [k for k, other in enumerate(between) if other == pair] for pair in between}
    suspects = []
    for pair, own in columns.items():
        if not close[:, own].any():
            found[pair] = "Never"
        elif close[:, own].any(axis=1).mean() >= least(pair):
            suspects.append(pair)
    if suspects:
        touching = _hits(model, geometry, configurations, 0.0)
        found.update({pair: "Always" for pair in suspects
                      if touching[:, columns[pair]].any(axis=1).mean() >= least(pair)})
    return [DisabledPair(one, other, found[one, other])
            for i, one in enumerate(links) for other in links[i + 1:] if (one, other) in found]


def sample_configurations(robot: RobotModel, samples: int, rng: np.random.Generator) -> Array:
    """Return random configurations (samples, nq) of the full model: group and gripper vary, the rest is locked."""
    model = robot.full_model
    configurations = np.tile(robot.full_reference, (samples, 1))

    def column(joint: str) -> int:
        return int(model.joints[model.getJointId(joint)].idx_q)

    configurations[:, [column(joint) for joint in robot.joint_names]] = rng.uniform(
        robot.lower, robot.upper, (samples, robot.dof)
    )
    gripper = robot.config.gripper
    if gripper is not None:
        widths = rng.uniform(0.0, gripper.max_width, samples)
        fingers = np.array([finger_positions(gripper, float(width)) for width in widths])
        for values, joint in zip(fingers.T, gripper.joints, strict=True):
            configurations[:, column(joint)] = values
    return configurations


def _carrier(robot: RobotModel, link: str, with_geometry: list[str]) -> str:
    """Return the nearest parent link that has a shape."""
    parent = robot.link_parents.get(link, "")
    while parent and parent not in with_geometry:
        parent = robot.link_parents.get(parent, "")
    return parent


def _hits(model: pin.Model, geometry: pin.GeometryModel, configurations: Array, margin: float) -> NDArray[np.bool_]:
    """Return (N, pairs) whether the shapes of each pair are closer than a margin [m] at each configuration."""
    data, shapes = model.createData(), pin.GeometryData(geometry)
    for request in shapes.collisionRequests:
        request.security_margin = margin
    hits = np.zeros((len(configurations), len(geometry.collisionPairs)), dtype=bool)
    for row, q in zip(hits, configurations, strict=True):
        pin.computeCollisions(model, data, geometry, shapes, q, False)
        row[:] = [result.isCollision() for result in shapes.collisionResults]
    return hits


def srdf(robot: RobotModel, pairs: list[DisabledPair]) -> str:
    """Return an SRDF: groups and named poses of the robot file, and the pairs that are not checked."""
    config = robot.config
    root = ET.Element("robot", name=robot.full_model.name)
    ET.SubElement(root, "virtual_joint", name="base", type="fixed", parent_frame="world", child_link=config.base_link)
    arm = ET.SubElement(root, "group", name=config.group)
    ET.SubElement(arm, "chain", base_link=config.base_link, tip_link=config.tcp_link)
    gripper = config.gripper
    if gripper is not None:
        fingers = ET.SubElement(root, "group", name=gripper.group)
        for joint in gripper.joints:
            ET.SubElement(fingers, "joint", name=joint)
    states = [(name, config.group, config.joints, positions) for name, positions in config.named_poses.items()]
    if gripper is not None:
        states += [(name, gripper.group, gripper.joints, finger_positions(gripper, width))
                   for name, width in gripper.named_widths.items()]
    for name, group, joints, positions in states:
        state = ET.SubElement(root, "group_state", name=name, group=group)
        for joint, position in zip(joints, positions, strict=True):
            ET.SubElement(state, "joint", name=joint, value=f"{round(position, 6) + 0.0:g}")
    for pair in pairs:
        ET.SubElement(root, "disable_collisions", link1=pair.one, link2=pair.other, reason=pair.reason)
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
