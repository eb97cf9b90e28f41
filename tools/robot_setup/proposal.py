"""The robot file of a URDF: read where the URDF says it, measured on the model, or guessed by rules that it states."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.config import RobotConfig, check
from common.errors import ConfigError
from common.planning.disabled_collisions import disabled_pairs, srdf
from common.planning.robot_geometry import RobotGeometry
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import invert, matrix_to_rpy, transform
from common.robot.urdf import read_urdf
from tools.robot_setup.end_effector import (
    GripperProposal,
    complaints,
    find_flange,
    find_gripper,
    flange_links,
    rotation_between,
    section,
)
from tools.robot_setup.fingers import ALIGNED, link_points
from tools.robot_setup.home import find_home
from tools.robot_setup.tree import (
    SPEED,
    TO_ACCELERATION,
    TO_SPEED,
    Arm,
    Joint,
    Tree,
    find_arm,
    guessed_acceleration,
    guessed_jerk,
    position_range,
    read_tree,
)

Array = NDArray[np.float64]

NEAR_GRIP = 0.03  # a link of the URDF so close to where fingers grip may be the tool centre point [m]
BEHIND_TIPS = 0.01  # where fingers grip [m]


@dataclass(frozen=True)
class Candidate:
    """A link that may be the tool centre point: which way its z axis points, and whether that is out of the tool."""

    link: str
    z: str
    fits: bool


@dataclass
class Proposal:
    """A robot file that is still to be written.

    Attributes:
        values: of the file, by field.
        notes: comments, by field.
        candidates: for the tool centre point.
        guessed: what nobody said; check: what a person should look at; lost: what the robot cannot do so.
        srdf: text of the pairs of links that are not checked.
    """

    values: dict[str, Any]
    notes: dict[str, str] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    guessed: list[str] = field(default_factory=list)
    check: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    srdf: str = ""


def draft(
    urdf: str, name: str, *, gripper: str = "", tip: str | None = None, package_dirs: Sequence[str] = (),
) -> Proposal:
    """The robot file of an arm, whose home and pairs of links that need no check are still to be found: see `finish`.

    Args:
        urdf: its description: a path, or package://...
        name: of the robot.
        gripper: description of a gripper that is mounted at its end.
        tip: a link at its end, where it has several: the tool centre point, or what a gripper is mounted on.
        package_dirs: folders in which package:// is looked up.

    Raises:
        ConfigError, UnknownName: what is wrong with the descriptions, in one line.
    """
    tree = read_tree(read_urdf("urdf", urdf, package_dirs), urdf)
    arm = find_arm(tree, urdf, tip)
    made = Proposal({
        "name": name, "urdf": urdf, "package_dirs": list(package_dirs),
        "joints": [joint.name for joint in arm.joints], "base_link": arm.base, "tcp_link": arm.wrist,
    })
    _limits(made, arm)
    others = [joint for joint in tree.joints if joint.moves and joint not in arm.joints]
    fingers = list(arm.fingers)
    if gripper:
        if fingers:
            raise ConfigError("--gripper", gripper, f"cannot be mounted: {fingers[0].name} moves there already")
        fingers = _mount(made, tree, arm, gripper, tip, package_dirs)
        others += fingers
    made.values["locked_joints"] = {joint.name: _rest(joint) for joint in others}
    middle = [(low + high) / 2 for low, high in made.values["position_limits"]]
    made.values["named_poses"] = {"home": middle}
    robot = _model(made)
    points = link_points(robot)
    whole = read_tree(ET.fromstring(robot.urdf), urdf)
    hand: GripperProposal | None = None
    if fingers:
        found = find_gripper(robot, whole, fingers, points)
        if isinstance(found, GripperProposal):
            hand = found
        else:
            made.lost.append(f"no gripper: {found}")
    if hand is not None and gripper:
        robot, hand = _turned(made, robot, tree, arm, whole, fingers, points, hand)
    _tool(made, robot, whole, arm, hand, points, tip if not gripper else None)
    return made


def _model(made: Proposal) -> RobotModel:
    return RobotModel.load(check(RobotConfig, made.values, "robot"))


def _rest(joint: Joint) -> float:
    """Where a joint that is not planned for is held: 0, or as near as its limits let it."""
    low, high = (joint.lower or 0.0, joint.upper or 0.0) if joint.kind != "continuous" else (0.0, 0.0)
    return min(max(0.0, low), high)


def _limits(made: Proposal, arm: Arm) -> None:
    """What the joints may do: as the URDF says, narrower where they turn on, and guessed where it is silent."""
    positions: list[tuple[float, float]] = []
    speeds: list[float] = []
    narrowed, silent = [], []
    for joint in arm.joints:
        low, high, changed = position_range(joint)
        positions.append((low, high))
        if changed:
            narrowed.append(joint.name)
        if not joint.velocity:
            silent.append(joint.name)
        speeds.append(joint.velocity or SPEED)
    accelerations = [guessed_acceleration(speed) for speed in speeds]
    made.values["position_limits"], made.values["velocity_limits"] = positions, speeds
    made.values["acceleration_limits"] = accelerations
    made.values["jerk_limits"] = [guessed_jerk(acceleration) for acceleration in accelerations]
    if narrowed:
        made.notes["position_limits"] = (
            f"The URDF's, but for {', '.join(narrowed)}, which turn farther than once round: half a turn either way, "
            "since a second way round only misleads planning.")
        made.guessed.append(f"position_limits of {', '.join(narrowed)}: half a turn either way")
    if silent:
        made.guessed.append(f"velocity_limits of {', '.join(silent)}: the URDF gives none, so {SPEED:g}")
        made.notes["velocity_limits"] = f"GUESSED for {', '.join(silent)}, for which the URDF gives none."
    made.notes["acceleration_limits"] = (
        f"GUESSED: each joint comes to its speed limit in {TO_SPEED:g} s. A URDF does not say it; the data sheet does.")
    made.notes["jerk_limits"] = f"GUESSED: each joint comes to its acceleration limit in {TO_ACCELERATION:g} s."
    made.guessed += [f"acceleration_limits: to the speed limit in {TO_SPEED:g} s",
                     f"jerk_limits: to the acceleration limit in {TO_ACCELERATION:g} s"]


def _mount(
    made: Proposal, tree: Tree, arm: Arm, gripper: str, tip: str | None, package_dirs: Sequence[str]
) -> list[Joint]:
    """Attach a gripper to the flange; its joints that move."""
    part = read_tree(read_urdf("--gripper", gripper, package_dirs), gripper)
    moving = [joint for joint in part.joints if joint.moves]
    if not moving:
        raise ConfigError("--gripper", gripper, "has no joint that moves: it is no gripper")
    others = {joint.name: _rest(joint) for joint in tree.joints if joint.moves and joint not in arm.joints}
    middle = [(low + high) / 2 for low, high in made.values["position_limits"]]
    alone = Proposal(made.values | {"locked_joints": others, "named_poses": {"home": middle}})
    flange, _ = find_flange(_model(alone), tree, arm, tip)
    made.values["attachments"] = [{"urdf": gripper, "parent_link": flange}]
    return moving


def _turned(
    made: Proposal, robot: RobotModel, tree: Tree, arm: Arm, whole: Tree, fingers: list[Joint],
    points: dict[str, Array], hand: GripperProposal,
) -> tuple[RobotModel, GripperProposal]:
    """Turn a mounted gripper so that its fingers point out of the flange."""
    (attachment,) = made.values["attachments"]
    flange, out = find_flange(robot, tree, arm, attachment["parent_link"])
    poses = robot.link_poses((robot.lower + robot.upper) / 2)
    T_flange_palm = invert(poses[flange]) @ poses[hand.palm]
    points_out = T_flange_palm[:3, :3] @ hand.grip.approach
    made.guessed.append(f"attachments: the gripper sits at {flange} itself, without a plate between")
    if points_out @ out > ALIGNED:
        return robot, hand
    attachment["rpy"] = [round(value, 6) for value in matrix_to_rpy(rotation_between(points_out, out))]
    robot = _model(made)
    found = find_gripper(robot, whole, fingers, points)
    assert isinstance(found, GripperProposal)  # as before: it was only turned
    return robot, found


def _tool(
    made: Proposal, robot: RobotModel, whole: Tree, arm: Arm, hand: GripperProposal | None, points: dict[str, Array],
    tip: str | None,
) -> None:
    """The tool centre point: a link of the URDF that is where it should be, else a frame of its own; the gripper."""
    poses = robot.link_poses((robot.lower + robot.upper) / 2)
    links = whole.rigid_with(arm.wrist)
    if hand is not None:
        grip, palm = hand.grip, hand.palm
        T_palm_tcp = transform(np.column_stack([np.cross(grip.closing, grip.approach), grip.closing, grip.approach]),
                               grip.middle - BEHIND_TIPS * grip.approach)
        parent = palm
        out = poses[palm][:3, :3] @ grip.approach
        near = [link for link in links if _distance(poses[link], poses[palm] @ T_palm_tcp) < NEAR_GRIP]
        if hand.jaw:  # between the open jaws is no link of a description
            near = []
    else:
        parent, out_in_flange = find_flange(robot, whole, arm, tip)
        out = poses[parent][:3, :3] @ out_in_flange
        T_palm_tcp = transform(rotation_between(np.array([0.0, 0.0, 1.0]), out_in_flange), (0.0, 0.0, 0.0))
        near = flange_links(whole, arm) if tip is None else [tip]
        if tip is None:
            near = [link for link in near if _distance(poses[link], poses[parent]) < 1e-3] or near
    made.candidates = [
        Candidate(link, _direction(poses[link][:3, :3].T @ out),
                  float(poses[link][:3, 2] @ out) > ALIGNED and _closes(poses, link, hand) != "")
        for link in (near if near else flange_links(whole, arm))
    ]
    fitting = [each.link for each in made.candidates if each.fits]
    if hand is None and parent in fitting:
        fitting = [parent]
    asked = tip if tip in fitting else None
    if fitting and (asked or near):
        made.values["tcp_link"] = asked or min(
            fitting, key=lambda link: _distance(poses[link], poses[parent] @ T_palm_tcp))
        closing = _closes(poses, made.values["tcp_link"], hand)
    else:
        rpy = [round(value, 6) + 0.0 for value in matrix_to_rpy(T_palm_tcp[:3, :3])]
        place = [round(float(value), 5) + 0.0 for value in T_palm_tcp[:3, 3]]
        made.values["tcp"] = {"link": f"{made.values['name']}_tcp", "parent": parent, "position": place, "rpy": rpy}
        del made.values["tcp_link"]
        closing = "y"
        made.notes["tcp"] = ("No link of the URDF is there with z out of the tool: this frame is, "
                             + ("1 cm behind the tips of the fingers, which close along its y axis." if hand else
                                f"at {parent}."))
        made.guessed.append(f"tcp: a frame of its own at {parent}")
    if hand is not None:
        _write_gripper(made, hand, closing)
    else:
        made.check.append("gripper: the robot file has none, so the robot grasps nothing; --gripper mounts one")


def _distance(one: Array, other: Array) -> float:
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3]))


def _direction(out: Array) -> str:
    """Which way z of a frame points, where out of the tool is `out` in that frame."""
    if out[2] > ALIGNED:
        return "out of the tool"
    return "back into the arm" if out[2] < -ALIGNED else "sideways"


def _closes(poses: dict[str, Array], link: str, hand: GripperProposal | None) -> str:
    """The axis of a link along which the fingers close; empty where they close between them."""
    if hand is None:
        return "y"
    closing = poses[link][:3, :3].T @ poses[hand.palm][:3, :3] @ hand.grip.closing
    return next((axis for axis, value in zip("xy", closing, strict=False) if abs(value) > ALIGNED), "")


def _write_gripper(made: Proposal, hand: GripperProposal, closing: str) -> None:
    made.values["gripper"] = section(hand, closing)
    made.notes["gripper"] = "Widths and tips are measured on the model. GUESSED by the platform: effort, acceleration."
    made.guessed.append("gripper.effort, max_effort, acceleration, jerk: the platform's defaults")
    made.check += hand.remarks
    config = check(RobotConfig, made.values, "robot")
    assert config.gripper is not None
    opened = zip(hand.joints, finger_positions(config.gripper, hand.max_width), strict=True)
    made.values["locked_joints"] |= {name: round(position, 6) + 0.0 for name, position in opened}
    made.notes["locked_joints"] = "Joints outside the arm, where planning holds them; fingers are open."


def finish(made: Proposal) -> RobotModel:
    """Find the pairs of links that need no check, and a home: some seconds of work, a minute with detailed meshes."""
    robot = _model(made)
    pairs = disabled_pairs(robot)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pairs.srdf"
        path.write_text(srdf(robot, pairs), encoding="utf-8")
        robot = RobotModel.load(robot.config.model_copy(update={"srdf": str(path)}))
        home = find_home(robot, RobotGeometry(robot))
    made.values["named_poses"] = {"home": [round(float(value), 4) + 0.0 for value in home.positions]}
    robot = _model(made)
    made.srdf = srdf(robot, pairs)
    x, y, z = robot.fk(robot.named("home"))[:3, 3]
    if home.down:
        made.notes["named_poses"] = f"Tool down, {robot.config.tcp_link} at ({x:.2f}, {y:.2f}, {z:.2f})."
    else:
        made.lost.append("no pose was found in which the tool points down: tasks that take things from above will fail")
    if home.hits:
        made.lost.append(f"no pose is free of collisions; in the middle of the joints these touch: "
                         f"{', '.join(home.hits[:3])}")
    made.guessed.append(f"named_poses.home: the tool at ({x:.2f}, {y:.2f}, {z:.2f})")
    made.check += complaints(robot)
    made.check.append("base_position: is not given, so the base stands at the origin of the world")
    return robot
