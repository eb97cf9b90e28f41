"""Proposes the robot file of a URDF: values from the URDF, measured on the model, or guessed by documented rules."""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.config import RobotConfig, check
from common.errors import ConfigError
from common.planning.robot_geometry import RobotGeometry
from common.robot.description_values import FARTHEST
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel
from common.robot.transforms import invert, matrix_to_rpy, transform
from common.robot.urdf import read_urdf
from tools.robot_setup.end_effector import (
    GripperProposal,
    check_gripper,
    find_flange,
    find_gripper,
    flange_links,
    rotation_between,
    section,
)
from tools.robot_setup.fingers import ALIGNED, link_points
from tools.robot_setup.maker_srdf import fitting_poses
from tools.robot_setup.mounting import find_mount
from tools.robot_setup.plausibility import FASTEST, bare_links, doubts
from tools.robot_setup.sampling import DisabledPair, find_home, srdf, survey_pairs
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

NEAR_GRIP = 0.03  # a link this close to the grip may be the tool centre point [m]
BEHIND_TIPS = 0.01  # of the fingers is the grip [m]


@dataclass(frozen=True)
class Candidate:
    """A link that may be the tool centre point: direction of its z axis, and whether that is out of the tool."""

    link: str
    z: str
    fits: bool


@dataclass
class Proposal:
    """Content of a robot file.

    Attributes:
        values: of the file, by field.
        notes: comments, by field.
        candidates: for the tool centre point.
        guessed: guessed values; check: what the user should check; lost: what the robot cannot do.
        srdf: pairs of links without collision checks, as text.
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
    group: Sequence[str] = (), allowed_pairs: Sequence[tuple[str, str]] = (),
) -> Proposal:
    """Return the robot file of an arm without home pose and unchecked pairs, which `finish` adds.

    Args:
        urdf: its description: a path or package://...
        name: of the robot.
        gripper: description of a gripper that is mounted at its end.
        tip: the tool centre point or mounting link, if the arm has several ends.
        package_dirs: folders that resolve package://.
        group: joints of the arm, if the maker's SRDF states them.
        allowed_pairs: pairs of links that may touch.

    Raises:
        ConfigError, UnknownName: a description is invalid.
    """
    tree = read_tree(read_urdf("urdf", urdf, package_dirs), urdf)
    arm = find_arm(tree, urdf, tip, group)
    proposal = Proposal({
        "name": name, "urdf": urdf, "package_dirs": list(package_dirs),
        "joints": [joint.name for joint in arm.joints], "base_link": arm.base, "tcp_link": arm.wrist,
        "allowed_pairs": list(allowed_pairs),
    })
    _limits(proposal, arm)
    others = [joint for joint in tree.joints if joint.moves and joint not in arm.joints]
    fingers = list(arm.fingers)
    if gripper:
        if fingers:
            raise ConfigError("--gripper", gripper, f"cannot be mounted: {fingers[0].name} moves there already")
        fingers = _mount(proposal, tree, arm, gripper, tip, package_dirs)
        others += fingers
    proposal.values["locked_joints"] = {joint.name: _rest(joint) for joint in others}
    middle = [(low + high) / 2 for low, high in proposal.values["position_limits"]]
    proposal.values["named_poses"] = {"home": middle}
    robot = _model(proposal)
    if robot.reach > FARTHEST:
        raise ConfigError("urdf", urdf, f"has an arm that reaches {robot.reach:.4g} m, more than {FARTHEST:g}: its "
                                        "lengths look like millimetres, and must be m")
    if bare := bare_links(robot):
        proposal.values["visual_as_collision"] = bare
        proposal.notes["visual_as_collision"] = "Links that the URDF gives no collision shape."
        proposal.check.append(f"links with a visual and no collision shape: {', '.join(bare)}; they collide with the "
                              "convex hull of the visual (visual_as_collision)")
        robot = _model(proposal)
    proposal.check += doubts(robot, [*arm.joints, *fingers])
    points = link_points(robot)
    complete = read_tree(ET.fromstring(robot.urdf), urdf)
    effector: GripperProposal | None = None
    if fingers:
        found = find_gripper(robot, complete, fingers, points)
        if isinstance(found, GripperProposal):
            effector = found
        else:
            proposal.lost.append(f"no gripper: {found}")
    if effector is not None and gripper:
        robot, effector = _turned(proposal, robot, tree, arm, complete, fingers, points, effector)
    _tool(proposal, robot, complete, arm, effector, points, tip if not gripper else None)
    return proposal


def _model(proposal: Proposal) -> RobotModel:
    return RobotModel.load(check(RobotConfig, proposal.values, "robot"))


def _rest(joint: Joint) -> float:
    """Return the position of a locked joint: 0, or the nearest within its limits."""
    low, high = (joint.lower or 0.0, joint.upper or 0.0) if joint.kind != "continuous" else (0.0, 0.0)
    return min(max(0.0, low), high)


def _limits(proposal: Proposal, arm: Arm) -> None:
    """Add joint limits: those of the URDF, narrower for continuous joints, and guessed where it has none."""
    positions: list[tuple[float, float]] = []
    speeds: list[float] = []
    narrowed, missing = [], []
    for joint in arm.joints:
        low, high, changed = position_range(joint)
        positions.append((low, high))
        if changed:
            narrowed.append(joint.name)
        if not joint.velocity or joint.velocity > FASTEST:
            missing.append(joint.name)
        speeds.append(SPEED if joint.name in missing else joint.velocity or SPEED)
    accelerations = [guessed_acceleration(speed) for speed in speeds]
    proposal.values["position_limits"], proposal.values["velocity_limits"] = positions, speeds
    proposal.values["acceleration_limits"] = accelerations
    proposal.values["jerk_limits"] = [guessed_jerk(acceleration) for acceleration in accelerations]
    if narrowed:
        proposal.notes["position_limits"] = (
            f"The URDF's, but for {', '.join(narrowed)}, which turn farther than once round: half a turn either way, "
            "since a second way round only misleads planning.")
        proposal.guessed.append(f"position_limits of {', '.join(narrowed)}: half a turn either way")
    if missing:
        proposal.guessed.append(f"velocity_limits of {', '.join(missing)}: the URDF gives no usable one, so {SPEED:g}")
        proposal.notes["velocity_limits"] = f"GUESSED for {', '.join(missing)}, for which the URDF gives no usable one."
    proposal.notes["acceleration_limits"] = (
        f"GUESSED: each joint comes to its speed limit in {TO_SPEED:g} s. URDFs lack this value; see the data sheet.")
    proposal.notes["jerk_limits"] = f"GUESSED: each joint comes to its acceleration limit in {TO_ACCELERATION:g} s."
    proposal.guessed += [f"acceleration_limits: to the speed limit in {TO_SPEED:g} s",
                     f"jerk_limits: to the acceleration limit in {TO_ACCELERATION:g} s"]


def _mount(
    proposal: Proposal, tree: Tree, arm: Arm, gripper: str, tip: str | None, package_dirs: Sequence[str]
) -> list[Joint]:
    """Attach a gripper to the flange; return its moving joints."""
    part = read_tree(read_urdf("--gripper", gripper, package_dirs), gripper)
    moving = [joint for joint in part.joints if joint.moves]
    if not moving:
        raise ConfigError("--gripper", gripper, "has no moving joint: it is no gripper. For a suction cup, leave "
                          "--gripper out and add gripper.cup to the robot file (docs/extending.md)")
    others = {joint.name: _rest(joint) for joint in tree.joints if joint.moves and joint not in arm.joints}
    middle = [(low + high) / 2 for low, high in proposal.values["position_limits"]]
    alone = Proposal(proposal.values | {"locked_joints": others, "named_poses": {"home": middle}})
    flange, _ = find_flange(_model(alone), tree, arm, tip)
    proposal.values["attachments"] = [{"urdf": gripper, "parent_link": flange}]
    return moving


def _turned(
    proposal: Proposal, robot: RobotModel, tree: Tree, arm: Arm, complete: Tree, fingers: list[Joint],
    points: dict[str, Array], effector: GripperProposal,
) -> tuple[RobotModel, GripperProposal]:
    """Turn a mounted gripper so that its fingers point out of the flange."""
    (attachment,) = proposal.values["attachments"]
    flange, out = find_flange(robot, tree, arm, attachment["parent_link"])
    poses = robot.link_poses((robot.lower + robot.upper) / 2)
    T_flange_palm = invert(poses[flange]) @ poses[effector.palm]
    points_out = T_flange_palm[:3, :3] @ effector.grip.approach
    proposal.guessed.append(f"attachments: the gripper is mounted directly on {flange}, without a plate between")
    if points_out @ out > ALIGNED:
        return robot, effector
    attachment["rpy"] = [round(value, 6) for value in matrix_to_rpy(rotation_between(points_out, out))]
    robot = _model(proposal)
    found = find_gripper(robot, complete, fingers, points)
    assert isinstance(found, GripperProposal)  # it was found before the turn too
    return robot, found


def _tool(
    proposal: Proposal, robot: RobotModel, complete: Tree, arm: Arm, effector: GripperProposal | None,
    points: dict[str, Array], tip: str | None,
) -> None:
    """Add the tool centre point, a link of the URDF if one fits, else a new frame; and the gripper."""
    poses = robot.link_poses((robot.lower + robot.upper) / 2)
    links = complete.rigid_with(arm.wrist)
    if effector is not None:
        grip, palm = effector.grip, effector.palm
        T_palm_tcp = transform(np.column_stack([np.cross(grip.closing, grip.approach), grip.closing, grip.approach]),
                               grip.middle - BEHIND_TIPS * grip.approach)
        parent = palm
        out = poses[palm][:3, :3] @ grip.approach
        tcp = poses[palm] @ T_palm_tcp
        near = [link for link in links if _distance(poses[link], tcp) < NEAR_GRIP
                and (tcp - poses[link])[:3, 3] @ out < BEHIND_TIPS]  # else the tips reach the table before the grip
        if effector.jaw:  # descriptions have no link between the open jaws
            near = []
    else:
        parent, out_in_flange = find_flange(robot, complete, arm, tip)
        out = poses[parent][:3, :3] @ out_in_flange
        T_palm_tcp = transform(rotation_between(np.array([0.0, 0.0, 1.0]), out_in_flange), (0.0, 0.0, 0.0))
        near = flange_links(complete, arm) if tip is None else [tip]
        if tip is None:
            near = [link for link in near if _distance(poses[link], poses[parent]) < 1e-3] or near
    proposal.candidates = [
        Candidate(link, _direction(poses[link][:3, :3].T @ out),
                  float(poses[link][:3, 2] @ out) > ALIGNED and _closes(poses, link, effector) != "")
        for link in (near if near else flange_links(complete, arm))
    ]
    fitting = [each.link for each in proposal.candidates if each.fits]
    if effector is None and parent in fitting:
        fitting = [parent]
    asked = tip if tip in fitting else None
    if fitting and (asked or near):
        proposal.values["tcp_link"] = asked or min(
            fitting, key=lambda link: _distance(poses[link], poses[parent] @ T_palm_tcp))
        closing = _closes(poses, proposal.values["tcp_link"], effector)
    else:
        rpy = [round(value, 6) + 0.0 for value in matrix_to_rpy(T_palm_tcp[:3, :3])]
        place = [round(float(value), 5) + 0.0 for value in T_palm_tcp[:3, 3]]
        name = f"{proposal.values['name']}_tcp"
        proposal.values["tcp"] = {"link": name, "parent": parent, "position": place, "rpy": rpy}
        del proposal.values["tcp_link"]
        closing = "y"
        proposal.notes["tcp"] = ("No link of the URDF at this position has z out of the tool, so this frame was added, "
                             + ("1 cm behind the tips of the fingers, which close along its y axis." if effector else
                                f"at {parent}."))
        proposal.guessed.append(f"tcp: a frame of its own at {parent}")
    if effector is not None:
        _write_gripper(proposal, effector, closing)
    else:
        proposal.check.append("gripper: the robot file has none, so the robot grasps nothing; --gripper mounts one")


def _distance(one: Array, other: Array) -> float:
    return float(np.linalg.norm(one[:3, 3] - other[:3, 3]))


def _direction(out: Array) -> str:
    """Return the direction of a frame's z axis; `out` points out of the tool in that frame."""
    if out[2] > ALIGNED:
        return "out of the tool"
    return "back into the arm" if out[2] < -ALIGNED else "sideways"


def _closes(poses: dict[str, Array], link: str, effector: GripperProposal | None) -> str:
    """Return the axis of a link along which the fingers close; empty if there is none."""
    if effector is None:
        return "y"
    closing = poses[link][:3, :3].T @ poses[effector.palm][:3, :3] @ effector.grip.closing
    return next((axis for axis, value in zip("xy", closing, strict=False) if abs(value) > ALIGNED), "")


def _write_gripper(proposal: Proposal, effector: GripperProposal, closing: str) -> None:
    proposal.values["gripper"] = section(effector, closing)
    proposal.notes["gripper"] = (
        "Widths and tips are measured on the model. GUESSED by the platform: effort, acceleration.")
    proposal.guessed.append("gripper.effort, max_effort, acceleration, jerk: the platform's defaults")
    proposal.check += effector.remarks
    config = check(RobotConfig, proposal.values, "robot")
    assert config.gripper is not None
    opened = zip(effector.joints, finger_positions(config.gripper, effector.max_width), strict=True)
    proposal.values["locked_joints"] |= {name: round(position, 6) + 0.0 for name, position in opened}
    proposal.notes["locked_joints"] = (
        "Joints outside the arm, at the positions that planning assumes; fingers are open.")


def finish(
    proposal: Proposal, pairs_of_maker: Sequence[tuple[str, str]] = (),
    poses: Mapping[str, Sequence[float]] | None = None,
) -> RobotModel:
    """Add the home pose and the unchecked pairs: seconds of work, a minute with detailed meshes.

    Args:
        proposal: a draft.
        pairs_of_maker: links that are not checked either.
        poses: further named poses. One that is called home is used as such if its tool points down and nothing touches.
    """
    robot = _mounted(proposal)
    pairs, overlaps = survey_pairs(robot)
    pairs += [DisabledPair(*links, "Maker") for links in pairs_of_maker
              if not any({pair.one, pair.other} == set(links) for pair in pairs)]
    allowed = [{*links} for links in (*pairs_of_maker, *robot.config.allowed_pairs)]
    proposal.check += [each.line for each in overlaps if {each.one, each.other} not in allowed]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pairs.srdf"
        path.write_text(srdf(robot, pairs), encoding="utf-8")
        robot = RobotModel.load(robot.config.model_copy(update={"srdf": str(path)}))
        geometry = RobotGeometry(robot)
        saved, remarks = fitting_poses(robot, geometry, poses or {})
        home = find_home(robot, geometry, saved.pop("home", None))
    proposal.check += remarks
    proposal.values["named_poses"] = {name: [round(float(value), 4) + 0.0 for value in q]
                                      for name, q in ({"home": home.positions} | saved).items()}
    robot = _model(proposal)
    proposal.srdf = srdf(robot, pairs)
    x, y, z = robot.fk(robot.named("home"))[:3, 3]
    if home.down:
        proposal.notes["named_poses"] = f"Tool down, {robot.config.tcp_link} at ({x:.2f}, {y:.2f}, {z:.2f})."
    else:
        proposal.lost.append("no pose was found in which the tool points down: tasks that grasp from above will fail")
    if home.hits:
        proposal.lost.append("no pose is free of collisions; in the middle of the joint ranges these collide: "
                         f"{', '.join(home.hits[:3])}")
    proposal.guessed.append(f"named_poses.home: the tool at ({x:.2f}, {y:.2f}, {z:.2f})")
    proposal.check += check_gripper(robot)
    return robot


def _mounted(proposal: Proposal) -> RobotModel:
    """Add where the base is, for an arm that does not stand on the table facing x."""
    robot = _model(proposal)
    mount = find_mount(robot)
    if not mount.height and not mount.yaw:
        proposal.check.append("base_position: not set, so the base is at the origin of the world")
        return robot
    proposal.values["base_position"] = [0.0, 0.0, -mount.height]
    proposal.values["base_rpy"] = [0.0, 0.0, round(mount.yaw, 6)]
    proposal.notes["base_position"] = (
        f"GUESSED: the top of the table is z = 0 of the world, {mount.height:g} m above the base, and the work is "
        "towards x, where this arm serves most of it with its tool down.")
    proposal.guessed.append(f"base_position, base_rpy: the base is {mount.height:g} m below the top of the table"
                            + (f", turned by {math.degrees(mount.yaw):.0f} degrees to face it" if mount.yaw else ""))
    return _model(proposal)
