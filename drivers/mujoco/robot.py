"""Add a robot to a MuJoCo spec: bodies, joints, masses, cached meshes of its URDF, and finger couplings."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.cache import Arrays, cached_arrays
from common.errors import ConfigError
from common.robot.collision_shapes import distinct, solid
from common.robot.description_values import numbers
from common.robot.finger_joints import finger_couplings
from common.robot.link_shapes import Shape, link_shapes, pose_of_origin
from common.robot.mesh_files import content_of, triangles_of
from common.robot.model import RobotModel
from common.robot.urdf import WORLD, find_description
from drivers.mujoco.scene import COLLIDES, SOLIMP, SOLREF, set_contact, set_finger_contact, visual_only, wxyz

if TYPE_CHECKING:
    from common.robot.visual_meshes import Piece


def hull_points(path: Path, scale: tuple[float, ...]) -> NDArray[np.float64]:
    """(n, 3) distinct vertices [m] of a mesh file; their convex hull is the collision shape.

    Raises:
        ConfigError: the file cannot be read, or has no extent.
    """
    def read() -> Arrays:
        corners = solid(triangles_of("robot.urdf", path) * np.array(scale), "robot.urdf", path)
        return {"points": distinct(corners)[0]}

    return cached_arrays("hull", [content_of("robot.urdf", path), repr(scale).encode()], read)["points"]


def cached_visual_meshes(robot: RobotModel, triangles: int) -> list[Piece]:
    """Visual meshes of all links, simplified to about this many triangles: see `common.robot.visual_meshes`."""
    from common.robot.visual_meshes import Piece, mesh_path, visible_shapes, visual_pieces  # imports trimesh

    files = [content_of("robot.urdf", mesh_path(robot, shape)) for shape in visible_shapes(robot) if shape.file]

    def make() -> Arrays:
        arrays: Arrays = {}
        for number, piece in enumerate(visual_pieces(robot, triangles)):
            red, green, blue = piece.color
            name = f"{number}|{piece.link}|{red}|{green}|{blue}"
            arrays[f"{name}|vertices"], arrays[f"{name}|faces"] = piece.vertices, piece.faces
        return arrays

    found = cached_arrays("visual", [robot.urdf.encode(), str(triangles).encode(), *files], make)
    pieces = {}
    for name, vertices in found.items():
        number, link, red, green, blue, what = name.split("|")
        if what == "vertices":
            faces = found[name.removesuffix(what) + "faces"]
            pieces[int(number)] = Piece(link, (int(red), int(green), int(blue)), vertices, faces)
    return [pieces[number] for number in sorted(pieces)]


Array = NDArray[np.float64]

DENSITY = 1500.0  # [kg/m^3] of a link without mass: a hollow metal housing
ARMATURE = 0.1  # [kg m^2 or kg] of motor and gear at an arm joint
FINGER_ARMATURE = 0.05  # [kg] with respect to the width
_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_JOINTS = {"revolute": _HINGE, "continuous": _HINGE, "prismatic": _SLIDE}
_TRIANGLES = 25_000  # of all visual meshes of a robot


def add_robot(spec: mujoco.MjSpec, robot: RobotModel, visuals: bool, category: int) -> None:
    """Add the robot with its base at the configured pose; one body per link, of its name, in a collision category.

    Raises:
        ConfigError: a URDF joint or shape is not supported, or a mesh cannot be read.
    """
    root = ET.fromstring(robot.urdf)
    links = {str(link.get("name")): link for link in root.findall("link")}
    joints = defaultdict(list)
    for joint in root.findall("joint"):
        joints[_link(joint, "parent")].append(joint)
    shapes: defaultdict[str, list[Shape]] = defaultdict(list)
    for shape in link_shapes(root, "collision", "robot.urdf", robot.config.urdf):
        shapes[shape.link].append(shape)
    seen: defaultdict[str, list[Piece]] = defaultdict(list)
    for piece in cached_visual_meshes(robot, _TRIANGLES) if visuals else ():
        seen[piece.link].append(piece)
    grippers = robot.config.gripper.links if robot.config.gripper else []

    def add(parent: Any, joint: ET.Element) -> None:
        name = _link(joint, "child")
        body = parent.add_body(name=name, gravcomp=1.0)  # arms compensate gravity
        _place(body, joint.find("origin"))
        _add_joint(body, joint, robot)
        _add_inertia(body, links[name])
        for index, shape in enumerate(shapes[name]):
            geom = _add_shape(spec, body, shape, f"{name}.{index}", robot)
            set_contact(geom, category, group=COLLIDES).density = DENSITY
            if name in grippers:
                set_finger_contact(geom)
        for index, piece in enumerate(seen[name]):
            mesh = spec.add_mesh(name=f"{name}.seen.{index}")
            mesh.uservert, mesh.userface = piece.vertices.ravel(), piece.faces.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            rgba = [*(part / 255 for part in piece.color), 1.0]
            visual_only(body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=rgba))
        for following in joints[name]:
            add(body, following)

    for joint in joints[WORLD]:
        add(spec.worldbody, joint)
    _couple(spec, root, robot)


def _link(joint: ET.Element, which: str) -> str:
    found = joint.find(which)
    return "" if found is None else str(found.get("link"))


def _place(element_: Any, origin: ET.Element | None) -> None:
    T = pose_of_origin(origin)
    element_.pos, element_.quat = T[:3, 3], wxyz(T[:3, :3])


def _add_joint(body: Any, joint: ET.Element, robot: RobotModel) -> None:
    kind, name = str(joint.get("type")), str(joint.get("name"))
    if kind == "fixed":
        return
    if kind not in _JOINTS:
        raise ConfigError("robot.urdf", name, f"is a {kind} joint, which is not supported; choices: fixed, "
                                              f"{', '.join(_JOINTS)}")
    limit, dynamics = joint.find("limit"), joint.find("dynamics")
    mj_joint = body.add_joint(name=name, type=_JOINTS[kind], axis=numbers(joint.find("axis"), "xyz", 3, "1 0 0"))
    low, high = (float(limit.get(end, 0.0)) if limit is not None else 0.0 for end in ("lower", "upper"))
    if low < high and kind != "continuous":  # a joint without range is locked
        mj_joint.range, mj_joint.limited = [low, high], True
    mj_joint.damping = [float(dynamics.get("damping", 0.0)) if dynamics is not None else 0.0, 0.0, 0.0]
    mj_joint.frictionloss = float(dynamics.get("friction", 0.0)) if dynamics is not None else 0.0
    mj_joint.armature = ARMATURE if name in robot.joint_names else 1e-4  # for fingers it depends on their linkage


def _add_inertia(body: Any, link: ET.Element) -> None:
    inertial = link.find("inertial")
    mass, inertia = (inertial.find(part) if inertial is not None else None for part in ("mass", "inertia"))
    if inertial is None or mass is None or inertia is None or float(mass.get("value", 0)) <= 0:
        return
    T = pose_of_origin(inertial.find("origin"))
    xx, yy, zz, xy, xz, yz = (float(inertia.get(f"i{axes}", 0)) for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    tensor = T[:3, :3] @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ T[:3, :3].T
    smallest = np.linalg.eigvalsh(tensor)[0]
    if smallest < 1e-7:  # some URDFs have unphysical inertias
        tensor = tensor + (1e-7 - smallest) * np.eye(3)
    body.explicitinertial, body.mass, body.ipos = True, float(mass.get("value", 0)), T[:3, 3]
    body.fullinertia = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]]


def _add_shape(spec: mujoco.MjSpec, body: Any, shape: Shape, name: str, robot: RobotModel) -> Any:
    geom, kinds, size = body.add_geom(name=name), mujoco.mjtGeom, shape.size
    geom.pos, geom.quat = shape.T_link_shape[:3, 3], wxyz(shape.T_link_shape[:3, :3])
    if shape.kind == "mesh":
        corners = hull_points(find_description("robot.urdf", shape.file, robot.config.package_dirs), size)
        mesh = spec.add_mesh(name=name)
        mesh.uservert = corners.ravel()
        geom.type, geom.meshname = kinds.mjGEOM_MESH, name
    elif shape.kind == "box":
        geom.type, geom.size = kinds.mjGEOM_BOX, [side / 2 for side in size]
    elif shape.kind == "sphere":
        geom.type, geom.size = kinds.mjGEOM_SPHERE, [size[0], 0.0, 0.0]
    else:
        geom.type = kinds.mjGEOM_CYLINDER if shape.kind == "cylinder" else kinds.mjGEOM_CAPSULE
        geom.size = [size[0], size[1] / 2, 0.0]
    return geom


def _couple(spec: mujoco.MjSpec, root: ET.Element, robot: RobotModel) -> None:
    """Couple fingers to the driven one and mimic joints to theirs; lock undriven joints."""
    gripper = robot.config.gripper
    follows: dict[str, tuple[str, float, float]] = {}
    if gripper is not None and gripper.joints:
        driven, *others = gripper.joints
        for name, coupling in zip(others, finger_couplings(gripper)[1:], strict=True):
            follows[name] = driven, *coupling
    moved = {*robot.joint_names, *follows, *(gripper.joints[:1] if gripper else [])}
    for joint in root.findall("joint"):
        name, mimic = str(joint.get("name")), joint.find("mimic")
        if joint.get("type") == "fixed" or name in moved:
            continue
        if mimic is not None:
            factor, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            follows[name] = str(mimic.get("joint")), factor, offset
        else:
            follows[name] = "", 0.0, robot.config.locked_joints.get(name, 0.0)
    for name, (other, factor, offset) in follows.items():
        spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name=f"{name} follows",
                          name1=name, name2=other, data=[offset, factor] + [0.0] * 10, solref=SOLREF, solimp=SOLIMP)
