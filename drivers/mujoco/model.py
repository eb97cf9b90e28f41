"""MuJoCo model of a cell from its configuration, for dynamics and for rendering; object states from physics.

    cell = build_model({"": RobotModel.load(config.robot)}, config.world, objects)
    data = mujoco.MjData(cell.model)
    cell.set_joints(data, joint_names, positions)
    cell.set_object(data, "cup", T_world_cup)
    mujoco.mj_forward(cell.model, data)

Frames are the project's: link bodies have their URDF names and frames, world is world. With several arms, names of
links, joints and servos begin with that of the arm: `left/link0`. Geoms of group `scene.SEEN` are only
visual, those of `scene.COLLIDES` only collide, all others are both. Objects, floor, fixtures and containers have
their configured colors; the model has no lights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Surroundings, World
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion, quaternion_to_matrix, transform
from common.sim.bodies import Body, State
from common.sim.table import is_inside
from drivers.mujoco.robot import add_robot
from drivers.mujoco.scene import (
    FIXED,
    IMPRATIO,
    ROBOT,
    TIMESTEP,
    SceneObject,
    add_cameras,
    add_lip,
    add_object,
    add_surroundings,
    arm_category,
)

Array = NDArray[np.float64]

AWAY = 10.0  # [m] between objects without a pose


class Address(NamedTuple):
    """Addresses of an object: its body, and the first of its 7 positions and 6 velocities."""

    body: int
    qpos: int
    dof: int


@dataclass(frozen=True, eq=False)
class CellModel:
    """A compiled model and the addresses in it.

    Attributes:
        spec: source; may be modified (lights, materials) and recompiled with `compiled`.
        joints, dofs: index into qpos and qvel of each joint of the arms, by name.
        actuators: index of the servo of each driven joint, by joint name.
        things: addresses of objects by id.
        start: qpos with the arms at home and open fingers; objects are far away and apart.
    """

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    joints: dict[str, int]
    dofs: dict[str, int]
    actuators: dict[str, int]
    objects: dict[str, Address]
    start: Array

    def set_joints(self, data: mujoco.MjData, names: Sequence[str], positions: Iterable[float]) -> None:
        """Write joint positions [rad or m]; KeyError for an unknown name."""
        for name, position in zip(names, positions, strict=True):
            data.qpos[self.joints[name]] = position

    def set_object(self, data: mujoco.MjData, name: str, T: Array) -> None:
        """Write the pose (4, 4) of an object in world."""
        address = self.objects[name]
        x, y, z, w = matrix_to_quaternion(T[:3, :3])
        data.qpos[address.qpos: address.qpos + 7] = [*T[:3, 3], w, x, y, z]

    def pose_of(self, data: mujoco.MjData, name: str) -> Array:
        """(4, 4) pose of an object in world."""
        at = self.objects[name].qpos
        x, y, z, qw, qx, qy, qz = data.qpos[at: at + 7].tolist()
        return transform(quaternion_to_matrix(qx, qy, qz, qw), (x, y, z))


def prefix(arm: str) -> str:
    """Return what names in the model begin with that belong to an arm; empty for the only one."""
    return f"{arm}/" if arm else ""


def build_model(
    robots: Mapping[str, RobotModel], world: Surroundings, objects: Sequence[SceneObject], *, visuals: bool = False
) -> CellModel:
    """Build the cell: robots, surroundings, objects and cameras.

    Args:
        robots: any that the planner supports, by arm; the name of the only one is empty. The first carries cameras.
        world: surroundings and cameras.
        things: each becomes a free body.
        visuals: include visual meshes, needed only for rendering.

    Raises:
        ConfigError: a part cannot be simulated.
    """
    spec = _new_spec()
    (first, carrier), *_ = robots.items()
    spec.modelname = carrier.config.name
    option = spec.option
    option.timestep, option.impratio = TIMESTEP, IMPRATIO
    option.noslip_iterations = world.slip_iterations if isinstance(world, World) else 0
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    add_surroundings(spec, world)
    for number, (arm, robot) in enumerate(robots.items()):
        part = _new_spec() if arm else spec
        _add_arm(part, robot, arm_category(number), visuals)
        if arm:
            spec.attach(part, prefix=prefix(arm), frame=spec.worldbody.add_frame())
    add_cameras(spec, world, carrier, prefix(first))
    for obj in objects:
        add_object(spec, obj)
    cell = compiled(spec, robots, [obj.id for obj in objects])
    if excluded := _contacts_at_home(cell):
        for pair in excluded:
            spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
        cell = compiled(spec, robots, [obj.id for obj in objects])
    return cell


def _new_spec() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.balanceinertia = 1e-4, 1e-7, True
    spec.compiler.degree = False
    return spec


def _add_arm(spec: mujoco.MjSpec, robot: RobotModel, category: int, visuals: bool) -> None:
    """Add an arm with its gripper, servos and force sensor, in a collision category."""
    gripper = robot.config.gripper
    add_robot(spec, robot, visuals, category)
    if gripper is not None and gripper.cup is not None:
        add_lip(spec, robot.config.tcp_link, gripper.cup, category)
    for name in [*robot.joint_names, *(gripper.joints[:1] if gripper else [])]:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=1.0, kv=1.0)  # gains: `arm.tune`
    _add_force_sensor(spec, robot)


FORCE_SENSOR = "flange force", "flange torque"


def _add_force_sensor(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    """Measure what acts on the flange from beyond it: force [N] and torque [N m] along the axes of its link."""
    site = spec.body(robot.flange_link).add_site(name="flange")
    for name, kind in zip(FORCE_SENSOR, (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE), strict=True):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name)


def compiled(spec: mujoco.MjSpec, robots: Mapping[str, RobotModel], objects: Iterable[str]) -> CellModel:
    """Compile a spec of `build_model`.

    Raises:
        ConfigError: MuJoCo rejects it.
    """
    try:
        model = spec.compile()
    except ValueError as error:
        raise ConfigError("world.simulator", "mujoco", f"cannot simulate this cell: {' '.join(str(error).split())}"
                          ) from None
    joints, dofs = {}, {}
    for number in range(model.njnt):
        name = model.joint(number).name
        if model.jnt_type[number] != mujoco.mjtJoint.mjJNT_FREE:
            joints[name], dofs[name] = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
    addresses = {}
    for obj in objects:
        joint, body = model.joint(f"object:{obj}"), model.body(f"object:{obj}")
        addresses[obj] = Address(int(body.id), int(joint.qposadr[0]), int(joint.dofadr[0]))
    actuators = {model.actuator(number).name: number for number in range(model.nu)}
    return CellModel(spec, model, joints, dofs, actuators, addresses, _start(model, robots, joints, addresses))


def _start(
    model: mujoco.MjModel, robots: Mapping[str, RobotModel], joints: Mapping[str, int], addresses: Mapping[str, Address]
) -> Array:
    start = np.array(model.qpos0)
    for number, address in enumerate(addresses.values()):  # else they would overlap
        start[address.qpos: address.qpos + 3] = 0.0, 0.0, (1 + number) * AWAY
    for arm, robot in robots.items():
        for name, position in robot.config.locked_joints.items():
            if prefix(arm) + name in joints:
                start[joints[prefix(arm) + name]] = position
        for name, position in zip(robot.joint_names, robot.named("home"), strict=True):
            start[joints[prefix(arm) + name]] = position
    return start


def _contacts_at_home(cell: CellModel) -> list[tuple[str, str]]:
    """Links and fixtures in contact at home: a robot standing in its table must not be pushed out."""
    model, data = cell.model, mujoco.MjData(cell.model)
    data.qpos[:] = cell.start
    mujoco.mj_forward(model, data)
    pairs = set()
    for contact in data.contact:
        first, second = sorted(contact.geom, key=lambda geom: bool(model.geom_contype[geom] == FIXED))
        if model.geom_contype[first] & ROBOT and model.geom_contype[second] == FIXED:
            pairs.add((model.body(model.geom_bodyid[first]).name, model.body(model.geom_bodyid[second]).name))
    return sorted(pairs)


MOVED = 1e-4  # [m] smallest published motion
TURNED = 1e-3  # [rad] smallest published rotation
UPRIGHT = 1 - 1e-6  # cosine of the tilt up to which an object counts as upright
RELEASE_TIME = 0.05  # [s] without finger contact after which an object is released
REST_SPEED = 0.02  # [m/s] of an object at rest


class Contacts:
    """Contacts of objects: with fingers, with the floor, and any."""

    def __init__(self, cell: CellModel, robots: Mapping[str, RobotModel]) -> None:
        """Start without contacts. A suction cup has no fingers."""
        model = cell.model
        self._names = list(cell.objects)
        number = {cell.objects[name].body: index for index, name in enumerate(self._names)}
        self._object = np.array([number.get(int(body), -1) for body in model.geom_bodyid])
        fingers = [(number, model.body(prefix(arm) + link).id) for number, (arm, robot) in enumerate(robots.items())
                   if (gripper := robot.config.gripper) is not None and gripper.cup is None for link in gripper.links]
        side = {body: index for index, (_, body) in enumerate(fingers)}
        self._arm = np.array([number for number, _ in fingers], int)
        self._side = np.array([side.get(int(body), -1) for body in model.geom_bodyid])
        self._floor = model.geom("floor").id

    def update(self, data: mujoco.MjData) -> tuple[set[str], set[str], set[str]]:
        """Names of objects touched by two links of one gripper, on the floor, and touching anything."""
        pairs = data.contact.geom
        if not len(pairs):
            return set(), set(), set()
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
        pairs = pairs[self._object[pairs[:, 0]] >= 0]
        objects, others = self._object[pairs[:, 0]], pairs[:, 1]
        sides = self._side[others]
        fingers = np.unique(np.stack([objects[sides >= 0], sides[sides >= 0]]), axis=1)
        names, (found, count) = self._names, np.unique(
            np.stack([fingers[0], self._arm[fingers[1]]]), axis=1, return_counts=True)
        held = {names[index] for index in found[0][count >= 2]}
        return held, {names[index] for index in objects[others == self._floor]}, {names[index] for index in objects}


class ObjectStates:
    """State of each object, in the terms of the kinematic world."""

    def __init__(self, world: World) -> None:
        """Nothing is known yet."""
        self._world = world
        self._touched: dict[str, float] = {}  # by the fingers, when [s]
        self._on_floor: set[str] = set()

    def on_floor(self, name: str) -> None:
        """Mark an object as lying on the floor."""
        self._on_floor.add(name)

    def forget(self, name: str) -> None:
        """Reset an object that an operator moved."""
        self._touched.pop(name, None)
        self._on_floor.discard(name)

    def update(self, now: float, contacts: tuple[set[str], set[str], set[str]], bodies: Mapping[str, Body]) -> None:
        """Update with the contacts at a time [s]."""
        held, floor, _ = contacts
        self._on_floor = (self._on_floor | floor) & bodies.keys()
        for name in held:
            self._touched[name] = now
        self._touched = {name: at for name, at in self._touched.items() if now - at < RELEASE_TIME and name in bodies}

    def state_of(self, body: Body, T: Array, supported: bool) -> tuple[State, str]:
        """State of a body at (4, 4), and the container that holds it."""
        if body.name in self._on_floor:
            return "elsewhere", ""
        if body.name in self._touched:
            return "held", ""
        if not supported:
            return "falling", ""
        x, y, z = (float(value) for value in T[:3, 3])
        top = self._world.table_height + 2 * body.solid.reach
        for container in self._world.containers.values():
            if is_inside(container, x, y) and self._world.table_height < z < top + container.wall_height:
                return "contained", container.id
        return "table", ""


def pose_changed(T: Array, other: Array) -> bool:
    """Whether two poses (4, 4) differ enough to be published."""
    if float(np.abs(T[:3, 3] - other[:3, 3]).max()) > MOVED:
        return True
    cosine = (float(np.sum(T[:3, :3] * other[:3, :3])) - 1) / 2
    return math.acos(min(max(cosine, -1.0), 1.0)) > TURNED


def snap_upright(T: Array) -> Array:
    """Make a nearly upright pose exactly upright: physics tilts standing objects by microns."""
    if not UPRIGHT < T[2, 2] < 1:
        return T
    yaw = math.atan2(T[1, 0], T[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    return transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), (T[0, 3], T[1, 3], T[2, 3]))
