"""A MuJoCo model of a cell from its configuration, for who moves it and for who draws it.

    cell = build_model(RobotModel.load(config.robot), config.world, things)
    data = mujoco.MjData(cell.model)
    cell.set_joints(data, joint_names, positions)
    cell.set_object(data, "cup", T_world_cup)
    mujoco.mj_forward(cell.model, data)

All frames are the project's: bodies of links are called and placed as in the URDF, world is world. Geoms of group
`contact.SEEN` are only seen, those of `contact.COLLIDES` only collide, all others are both. Shapes of objects, the
floor, fixtures and containers have their configured colour; lights are not in the model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Surroundings
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion, quaternion_to_matrix, transform
from drivers.mujoco.robot import add_robot
from drivers.mujoco.scene import (
    FIXED,
    IMPRATIO,
    ROBOT,
    TIMESTEP,
    SceneObject,
    add_cameras,
    add_object,
    add_surroundings,
)

Array = NDArray[np.float64]

AWAY = 10.0  # [m]


class Place(NamedTuple):
    """Where an object is in a model: its body, and the first of its 7 positions and 6 velocities."""

    body: int
    qpos: int
    dof: int


@dataclass(frozen=True, eq=False)
class CellModel:
    """A compiled model, and where in it everything is.

    Attributes:
        spec: what it was made of; can be changed (lights, materials) and compiled anew with `compiled`.
        joints, dofs: index into qpos and qvel of each joint of the robot, by name.
        actuators: index of the servo of each joint that has one, by the name of the joint.
        things: by id.
        start: qpos with the arm at home and fingers open; objects are far away, and from each other.
    """

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    joints: dict[str, int]
    dofs: dict[str, int]
    actuators: dict[str, int]
    things: dict[str, Place]
    start: Array

    def set_joints(self, data: mujoco.MjData, names: Sequence[str], positions: Iterable[float]) -> None:
        """Write positions [rad or m] of joints; names that the robot does not have raise KeyError."""
        for name, position in zip(names, positions, strict=True):
            data.qpos[self.joints[name]] = position

    def set_object(self, data: mujoco.MjData, name: str, T: Array) -> None:
        """Write the pose (4, 4) of an object in world."""
        place = self.things[name]
        x, y, z, w = matrix_to_quaternion(T[:3, :3])
        data.qpos[place.qpos: place.qpos + 7] = [*T[:3, 3], w, x, y, z]

    def pose_of(self, data: mujoco.MjData, name: str) -> Array:
        """(4, 4) pose of an object in world."""
        at = self.things[name].qpos
        x, y, z, qw, qx, qy, qz = data.qpos[at: at + 7].tolist()
        return transform(quaternion_to_matrix(qx, qy, qz, qw), (x, y, z))


def build_model(
    robot: RobotModel, world: Surroundings, things: Sequence[SceneObject], *, visuals: bool = False
) -> CellModel:
    """The cell: robot, what is fixed, objects and cameras.

    Args:
        robot: any that the planner takes.
        world: what is fixed, and the cameras.
        things: each becomes a free body.
        visuals: with the visual meshes of the robot, which only who draws needs.

    Raises:
        ConfigError: what of it cannot be simulated.
    """
    spec = mujoco.MjSpec()
    spec.modelname = robot.config.name
    option = spec.option
    option.timestep, option.impratio = TIMESTEP, IMPRATIO
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.balanceinertia = 1e-4, 1e-7, True
    spec.compiler.degree = False
    add_surroundings(spec, world)
    add_robot(spec, robot, visuals)
    add_cameras(spec, world, robot)
    for thing in things:
        add_object(spec, thing)
    gripper = robot.config.gripper
    for name in [*robot.joint_names, *(gripper.joints[:1] if gripper else [])]:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=1.0, kv=1.0)  # servo.tune says how stiff
    cell = compiled(spec, robot, [thing.id for thing in things])
    if touching := _fixed_to(cell):
        for pair in touching:
            spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
        cell = compiled(spec, robot, [thing.id for thing in things])
    return cell


def compiled(spec: mujoco.MjSpec, robot: RobotModel, things: Iterable[str]) -> CellModel:
    """The model of a spec that `build_model` made.

    Raises:
        ConfigError: MuJoCo does not take it.
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
    places = {}
    for thing in things:
        joint, body = model.joint(f"thing:{thing}"), model.body(f"thing:{thing}")
        places[thing] = Place(int(body.id), int(joint.qposadr[0]), int(joint.dofadr[0]))
    actuators = {model.actuator(number).name: number for number in range(model.nu)}
    return CellModel(spec, model, joints, dofs, actuators, places, _start(model, robot, joints, places))


def _start(model: mujoco.MjModel, robot: RobotModel, joints: Mapping[str, int], places: Mapping[str, Place]) -> Array:
    start = np.array(model.qpos0)
    for number, place in enumerate(places.values()):  # else all would touch all
        start[place.qpos: place.qpos + 3] = 0.0, 0.0, (1 + number) * AWAY
    for name, position in robot.config.locked_joints.items():
        if name in joints:
            start[joints[name]] = position
    for name, position in zip(robot.joint_names, robot.named("home"), strict=True):
        start[joints[name]] = position
    return start


def _fixed_to(cell: CellModel) -> list[tuple[str, str]]:
    """Links and fixtures that touch at home: one that stands in its table must not push itself out of it."""
    model, data = cell.model, mujoco.MjData(cell.model)
    data.qpos[:] = cell.start
    mujoco.mj_forward(model, data)
    pairs = set()
    for contact in data.contact:
        first, second = sorted(contact.geom, key=lambda geom: int(model.geom_contype[geom]))
        if (model.geom_contype[first], model.geom_contype[second]) == (ROBOT, FIXED):
            pairs.add((model.body(model.geom_bodyid[first]).name, model.body(model.geom_bodyid[second]).name))
    return sorted(pairs)
