"""The robot model: joints of the planning group, limits, forward kinematics."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.config import RobotConfig
from common.errors import ConfigError, UnknownName
from common.robot.description_values import MOVING
from common.robot.link_shapes import link_shapes
from common.robot.packages import package_folders
from common.robot.transforms import rpy_to_matrix
from common.robot.urdf import WORLD, find_description, merged_urdf

Array = NDArray[np.float64]


class RobotModel:
    """Kinematics of the planning group; joints outside it are locked at positions of the robot file.

    Poses are in `world`; the robot file defines the base pose. Not thread-safe: pinocchio's working data belong to the
    model, so each thread loads its own.

    Attributes:
        config: the robot file.
        urdf: text of the URDF with all attachments, rooted in a link `world`; srdf: path, or None.
        joint_names: joints of the group, in the order of every (dof,) array.
        lower, upper: position limits (dof,) [rad], from the robot file, else the URDF.
        velocity: limits (dof,) [rad/s], from the robot file, else the URDF.
        acceleration, jerk: limits (dof,) [rad/s^2], [rad/s^3], from the robot file.
        link_parents: link -> parent link, for every link but the root.
        full_model, model: pinocchio models with all joints and with those of the group.
        tcp_frame: index of the TCP's frame in `model`.
    """

    def __init__(self, config: RobotConfig, full_model: pin.Model, urdf: str, srdf: Path | None) -> None:
        """Reduce the full model to the group. Use `load`."""
        self.config = config
        self.urdf = urdf
        self.srdf = srdf
        self.full_model = full_model
        self.locked_ids, self.full_reference = _locked(config, full_model)
        self.model, _ = self.reduced(pin.GeometryModel())
        self.data = self.model.createData()
        self._full_data = full_model.createData()
        self.joint_names: list[str] = list(self.model.names)[1:]
        for element in ET.fromstring(urdf).findall("joint"):
            if element.get("name") in self.joint_names and (mimic := element.find("mimic")) is not None:
                raise ConfigError("robot.joints", element.get("name"),
                                  f"follows {mimic.get('joint')} (mimic); joints of an arm must move independently")
        if self.joint_names != config.joints:
            raise ConfigError("robot.joints", config.joints, f"must be in the URDF's order: {self.joint_names}")
        if self.model.nq != len(self.joint_names):
            raise ConfigError("robot.joints", config.joints, "must have one position each, unlike planar ones")
        self.dof: int = self.model.nq
        if config.position_limits:
            lowest, highest = np.array(config.position_limits, dtype=float).T
            self.model.lowerPositionLimit, self.model.upperPositionLimit = lowest, highest
        self.lower: Array = np.array(self.model.lowerPositionLimit)
        self.upper: Array = np.array(self.model.upperPositionLimit)
        self.velocity: Array = np.array(config.velocity_limits or self.model.velocityLimit, dtype=float)
        self.acceleration: Array = np.array(config.acceleration_limits, dtype=float)
        self.jerk: Array = np.array(config.jerk_limits, dtype=float)
        for name, low, high, speed in zip(self.joint_names, self.lower, self.upper, self.velocity, strict=True):
            if not (np.isfinite(low) and np.isfinite(high) and low < high and 0 < speed < np.inf):
                source = ("position_limits", [low, high]) if config.position_limits else ("urdf", config.urdf)
                raise ConfigError(f"robot.{source[0]}", source[1], f"has no usable limits for joint {name}")
        self._links = _link_frames(self.model)
        self._full_links = _link_frames(full_model)
        names = list(full_model.names)[1:]
        self._full_joints = {name: full_model.joints[full_model.getJointId(name)].idx_q for name in names}
        for field, link in (("tcp_link", config.tcp_link), ("base_link", config.base_link)):
            if link not in self._links:
                raise ConfigError(f"robot.{field}", link, f"is not a link; choices: {', '.join(self._links)}")
        self.tcp_frame: int = self._links[config.tcp_link]
        self.link_parents = _link_parents(full_model)
        self.flange_link = self._find_flange()
        for one, other in config.allowed_pairs:
            for each in (one, other):
                if each not in self._links:
                    raise ConfigError("robot.allowed_pairs", each, f"is not a link; choices: {', '.join(self._links)}")
            if one == other:
                raise ConfigError("robot.allowed_pairs", one, "is one link: a pair needs another one")
        for name, positions in config.named_poses.items():
            for joint, value, low, high in zip(self.joint_names, positions, self.lower, self.upper, strict=True):
                if not low <= value <= high:
                    field = f"robot.named_poses.{name}"
                    raise ConfigError(field, value, f"must be within {low:g} to {high:g} for joint {joint}")

    @classmethod
    def load(cls, config: RobotConfig) -> RobotModel:
        """Return the model of a robot file.

        Raises:
            ConfigError: a description is missing or does not fit the robot file; names the field and the choices.
        """
        urdf = merged_urdf(config)
        srdf = find_description("robot.srdf", config.srdf, config.package_dirs) if config.srdf else None
        try:
            full_model = pin.buildModelFromXML(_kinematics(urdf))
        except ValueError as error:
            raise ConfigError("robot.urdf", config.urdf, f"does not parse: {str(error).strip()}") from None
        if lost := sorted(_described_links(urdf) - set(_link_frames(full_model))):
            raise ConfigError("robot.urdf", config.urdf, f"has links that its parser dropped: {', '.join(lost)}")
        return cls(config, full_model, urdf, srdf)

    @property
    def reach(self) -> float:
        """Upper bound [m] of the TCP's distance from the first joint: all links stretched, all slides extended."""
        placements = [placement.translation for placement in self.model.jointPlacements[2:]]
        tcp = self.model.frames[self.tcp_frame].placement.translation
        slides = [max(abs(low), abs(high)) for joint, low, high in zip(
            self.model.joints[1:], self.lower, self.upper, strict=True) if joint.shortname().startswith("JointModelP")]
        return float(sum(np.linalg.norm(offset) for offset in (*placements, tcp)) + sum(slides))

    @property
    def foot(self) -> Array:
        """Position (3,) of the first joint [m], world."""
        return np.asarray(self.model.jointPlacements[1].translation)

    @property
    def package_folders(self) -> list[Path]:
        """Folders that are searched for the URDF's package:// meshes."""
        return package_folders(self.config.package_dirs)

    def full_geometry(self) -> pin.GeometryModel:
        """Return the collision shapes of all links, placed on the joints of `full_model`.

        Raises:
            ConfigError: a mesh is missing, cannot be read or has no extent.
        """
        from common.robot.collision_shapes import coal_shape

        shapes = defaultdict(list)
        for shape in link_shapes(ET.fromstring(self.urdf), "collision", "robot.urdf", self.config.urdf):
            shapes[shape.link].append(shape)
        geometry = pin.GeometryModel()
        for link, index in self._full_links.items():
            frame = self.full_model.frames[index]
            for number, shape in enumerate(shapes[link]):
                path = find_description("robot.urdf", shape.file, self.config.package_dirs) if shape.file else None
                geometry.addGeometryObject(pin.GeometryObject(
                    f"{link}_{number}", frame.parentJoint, index, frame.placement * pin.SE3(shape.T_link_shape),
                    coal_shape(shape, "robot.urdf", path)))
        return geometry

    def reduced(self, geometry: pin.GeometryModel) -> tuple[pin.Model, pin.GeometryModel]:
        """Return the model of the group, and shapes of `full_model` placed on its joints."""
        joints = set(self.full_model.names)
        alike = [i for i, f in enumerate(self.full_model.frames) if f.type == pin.FrameType.BODY and f.name in joints]
        names = [self.full_model.frames[i].name for i in alike]
        whole = self.full_model.copy()
        for index in alike:  # pinocchio reduces no model in which a link has the name of a joint
            whole.frames[index].name += " (link)"
        model, placed = pin.buildReducedModel(whole, geometry, self.locked_ids, self.full_reference)
        for name in names:
            model.frames[model.getFrameId(f"{name} (link)")].name = name
        return model, placed

    @property
    def groups(self) -> list[str]:
        """Names of the planning group."""
        return [self.config.group, *self.config.group_aliases]

    @property
    def world_frames(self) -> list[str]:
        """Names of frames that equal world: also the base link, if it is at the origin."""
        at_origin = not any(self.config.base_position) and not any(self.config.base_rpy)
        return ["", WORLD, *([self.config.base_link] if at_origin else [])]

    @property
    def link_names(self) -> list[str]:
        """All links of the robot."""
        return list(self._links)

    def frame(self, link: str) -> int:
        """Return the index of a link's frame in `model`; a joint may have the same name.

        Raises:
            UnknownName: with the choices.
        """
        if link not in self._links:
            raise UnknownName("link", link, list(self._links))
        return self._links[link]

    def fk(self, q: ArrayLike) -> Array:
        """Return (4, 4) T_world_tcp at joint positions q (dof,) [rad]."""
        pin.forwardKinematics(self.model, self.data, self._checked(q))
        return np.array(pin.updateFramePlacement(self.model, self.data, self.tcp_frame).homogeneous)

    def tool_speed(self, q: ArrayLike, dq: ArrayLike) -> float:
        """Return the speed [m/s] of the TCP at q (dof,) [rad] and dq (dof,) [rad/s]."""
        pin.forwardKinematics(self.model, self.data, self._checked(q), self._checked(dq))
        twist = pin.getFrameVelocity(self.model, self.data, self.tcp_frame, pin.ReferenceFrame.LOCAL)
        return float(np.linalg.norm(twist.linear))

    def jacobian(self, q: ArrayLike) -> Array:
        """Return the Jacobian (6, dof) of the TCP: linear [m/s], then angular [rad/s], along world's axes."""
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        found = pin.computeFrameJacobian(self.model, self.data, self._checked(q), self.tcp_frame, axes)
        return np.array(found).reshape(6, self.dof)  # pinocchio returns (6,) for one joint

    def _find_flange(self) -> str:
        """Return the link of the flange.

        Raises:
            ConfigError: it is no link, or does not move with the tool centre point.
        """
        config, last = self.config, self.model.frames[self.tcp_frame].parentJoint
        link = config.flange_link or (config.attachments[0].parent_link if config.attachments else "")
        on_last = [name for name, index in self._links.items() if self.model.frames[index].parentJoint == last]
        if not link:
            return on_last[0]
        if link not in on_last:
            raise ConfigError("robot.flange_link", link, "is no link that moves with the tool centre point; choices: "
                              f"{', '.join(on_last)}")
        return link

    @property
    def T_flange_tcp(self) -> Array:  # noqa: N802
        """Pose (4, 4) of the TCP in the flange: the axes of the flange are those of payloads and force sensors."""
        flange, tcp = (self.model.frames[index].placement for index in (self._links[self.flange_link], self.tcp_frame))
        return np.array(flange.actInv(tcp).homogeneous)

    @property
    def base_axes(self) -> Array:
        """Axes (3, 3) of the base in world."""
        return rpy_to_matrix(*self.config.base_rpy)

    def link_poses(self, q: ArrayLike, others: Mapping[str, float] | None = None) -> dict[str, Array]:
        """Return (4, 4) T_world_link of every link at q (dof,) [rad].

        Args:
            q: positions of the group.
            others: positions [rad or m] of joints outside the group, such as the gripper's; default: locked.
        """
        placed, links = self._placed(q, others), self._full_links if others else self._links
        return {name: np.array(placed[i].homogeneous) for name, i in links.items()}

    def poses_in_parents(
        self, links: Sequence[str], q: ArrayLike, others: Mapping[str, float] | None = None
    ) -> list[list[float]]:
        """Return each link's pose in its parent link: x, y, z [m], then a quaternion x, y, z, w >= 0.

        Args:
            links: not the root.
            q: positions of the group, (dof,) [rad].
            others: as in `link_poses`.
        """
        placed, index = self._placed(q, others), self._full_links if others else self._links
        found = []
        for link in links:
            in_parent = placed[index[self.link_parents[link]]].actInv(placed[index[link]])
            x, y, z, *quaternion = pin.SE3ToXYZQUAT(in_parent).tolist()
            found.append([x, y, z, *(quaternion if quaternion[3] >= 0 else [-value for value in quaternion])])
        return found

    def _placed(self, q: ArrayLike, others: Mapping[str, float] | None) -> pin.StdVec_SE3:
        """Return the placements of all frames: of the group's model, or with `others` of the full one."""
        checked = self._checked(q)
        if not others:
            pin.framesForwardKinematics(self.model, self.data, checked)
            return self.data.oMf
        full = self.full_reference.copy()
        for name, value in [*zip(self.joint_names, checked.tolist(), strict=True), *others.items()]:
            if name not in self._full_joints:
                raise UnknownName("joint", name, list(self._full_joints))
            full[self._full_joints[name]] = value
        pin.framesForwardKinematics(self.full_model, self._full_data, full)
        return self._full_data.oMf

    def named(self, name: str) -> Array:
        """Return joint positions (dof,) [rad] of a named pose of the robot file.

        Raises:
            UnknownName: with the choices.
        """
        if name not in self.config.named_poses:
            raise UnknownName("named pose", name, self.config.named_poses)
        return np.array(self.config.named_poses[name], dtype=float)

    def within_limits(self, q: ArrayLike, tolerance: float = 1e-6) -> bool:
        """Return whether all positions are within the joints' limits, up to the tolerance [rad]."""
        checked = self._checked(q)
        return bool(np.all(checked >= self.lower - tolerance) and np.all(checked <= self.upper + tolerance))

    def order(self, names: Sequence[str], values: Sequence[float]) -> Array | None:
        """Return values of the group's joints (dof,) from named ones; None if one is missing."""
        found = dict(zip(names, values, strict=True))
        try:
            return np.array([found[name] for name in self.joint_names], dtype=float)
        except KeyError:
            return None

    def _checked(self, q: ArrayLike) -> Array:
        array = np.asarray(q, dtype=float)
        if array.shape != (self.dof,):
            raise ValueError(f"joint positions have shape {array.shape}, not ({self.dof},)")
        return array


def _locked(config: RobotConfig, model: pin.Model) -> tuple[list[int], Array]:
    """Return indices of the joints outside the group, and a full configuration that locks them as in the file."""
    names = list(model.names)[1:]
    for name in [*config.joints, *config.locked_joints]:
        if name not in names:
            raise ConfigError("robot.joints", name, f"is not a joint of the URDF; choices: {', '.join(names)}")
    reference = np.array(pin.neutral(model))
    locked = []
    for name in names:
        if name in config.joints:
            continue
        if name not in config.locked_joints:
            raise ConfigError("robot.locked_joints", name, "is missing: the joint is in the URDF but not in the group")
        index = model.getJointId(name)
        reference[model.joints[index].idx_q] = config.locked_joints[name]
        locked.append(index)
    return locked, reference


def _link_frames(model: pin.Model) -> dict[str, int]:
    """Return the frame index of each link of the robot, without `world`."""
    return {f.name: i for i, f in enumerate(model.frames) if f.type == pin.FrameType.BODY and f.name != WORLD}


def _kinematics(urdf: str) -> str:
    """Return names of links, and joints: of all else, pinocchio's parser would print and skip what it cannot read."""
    root = ET.fromstring(urdf)
    found = ET.Element("robot", name=root.get("name") or "robot")
    for link in root.findall("link"):
        ET.SubElement(found, "link", name=str(link.get("name")))
    for joint in root.findall("joint"):
        for part in [*joint.findall("origin"), *joint.findall("axis"), *joint.findall("limit")]:
            part.attrib = {key: " ".join(value.split()) for key, value in part.items()}  # it accepts no other space
        parts = [part for part in joint if part.tag in ("parent", "child", "origin", "axis", "limit", "mimic")]
        ET.SubElement(found, "joint", name=str(joint.get("name")), type=str(joint.get("type"))).extend(
            part for part in parts if part.tag != "limit" or joint.get("type") in MOVING)
    return ET.tostring(found, encoding="unicode")


def _described_links(urdf: str) -> set[str]:
    return {str(link.get("name")) for link in ET.fromstring(urdf).findall("link")} - {WORLD}


def _link_parents(model: pin.Model) -> dict[str, str]:
    parents: dict[str, str] = {}
    for frame in model.frames:
        if frame.type != pin.FrameType.BODY:
            continue
        index = frame.parentFrame
        while index and model.frames[index].type != pin.FrameType.BODY:
            index = model.frames[index].parentFrame
        if model.frames[index].type == pin.FrameType.BODY and model.frames[index].name != WORLD:
            parents[frame.name] = model.frames[index].name
    return parents
