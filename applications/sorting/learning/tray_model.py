"""MuJoCo model of a tray, objects in it and a free parallel gripper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from common.config import Container
from common.robot.transforms import matrix_to_quaternion, quaternion_to_matrix, transform

Array = npt.NDArray[np.float64]

TIMESTEP = 0.002  # [s]
IMPRATIO = 10.0  # friction stiffer than contact: held objects do not creep
SLEEP = 1e-3  # [m/s] below which objects are at rest
SOLREF = (0.005, 1.0)  # time constant [s], damping: at 40 N pads sink in by less than 1 mm
CONDIM = 4  # sliding and torsion
TORSION, ROLLING = 0.005, 0.0001  # [m]
SURFACE_FRICTION = 0.6  # of tray and hand
OBJECT, FIXED, TOOL = 1, 2, 4  # collision categories
TOOL_GROUP, HIDDEN_GROUP = 5, 4  # of geoms that the camera does not see
HAND = "hand"
FINGERS = ("finger:0", "finger:1")
HAND_MASS, FINGER_MASS = 0.6, 0.06  # [kg]
STIFFNESS, DAMPING = 6000.0, 60.0  # [N/m], [N s/m] of each finger's servo
WELD = (0.008, 1.0)  # solref of the hand's weld


class HandShape(Protocol):
    """What the model needs of a gripper: boxes in its closing frame, y along which the fingers close, z the approach.

    Attributes:
        T_tcp_closing: (4, 4) pose of the closing frame in the frame of the tool center point.
        max_width: between the fully open fingers [m].
        table: (k, b, 2, 3) low and high corners [m] of the boxes at k widths, the last fully open.
        finger: (b,) which boxes belong to fingers; the others are the palm.
    """

    @property
    def T_tcp_closing(self) -> Array: ...  # noqa: D102
    @property
    def max_width(self) -> float: ...  # noqa: D102
    @property
    def table(self) -> Array: ...  # noqa: D102
    @property
    def finger(self) -> npt.NDArray[np.bool_]: ...  # noqa: D102


def new_spec() -> mujoco.MjSpec:
    """Return an empty model with the options of all benches."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.impratio = TIMESTEP, IMPRATIO
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # of objects at rest: a heap costs a third
    option.sleep_tolerance = SLEEP
    spec.compiler.boundmass, spec.compiler.boundinertia, spec.compiler.balanceinertia = 1e-4, 1e-7, True
    spec.compiler.degree = False
    return spec


def add_tray(spec: mujoco.MjSpec, tray: Container, table: float) -> None:
    """Add a table and the five panels of a tray on it."""
    plane = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2.0, 2.0, 0.1], pos=[0.0, 0.0, table],
                                    rgba=[0.42, 0.42, 0.44, 1.0])
    _set_contact(plane, FIXED, SURFACE_FRICTION)
    half, thick, height = tray.half_side, tray.wall_thickness / 2, tray.wall_height / 2
    off = half - thick
    panels = [((0.0, 0.0, tray.floor_thickness / 2), (half, half, tray.floor_thickness / 2))]
    panels += [((sign * off, 0.0, height), (thick, half, height)) for sign in (-1, 1)]
    panels += [((0.0, sign * off, height), (half - 2 * thick, thick, height)) for sign in (-1, 1)]
    for (x, y, z), size in panels:
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=[*tray.color, 1.0],
                                       pos=[tray.x + x, tray.y + y, table + z])
        _set_contact(geom, FIXED, SURFACE_FRICTION)


def add_object(
    spec: mujoco.MjSpec, number: int, parts: Sequence[Array], color: tuple[float, float, float], friction: float,
    surface: Array | None = None,
) -> None:
    """Add a free body `object:N`.

    Args:
        spec: model.
        number: of the object.
        parts: triangles (n, 3, 3) [m] of pieces, whose convex hulls collide.
        color: red, green, blue.
        friction: against all but the pads.
        surface: triangles (n, 3, 3) [m] that the camera sees; None: those of the parts.
    """
    name = f"object:{number}"
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    for index, triangles in enumerate(parts):
        mesh = spec.add_mesh(name=f"{name}.{index}")
        mesh.uservert = np.unique(np.asarray(triangles, float).reshape(-1, 3), axis=0).ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=[*color, 1.0])
        _set_contact(geom, OBJECT, friction)
        if surface is not None:
            geom.group = HIDDEN_GROUP
    if surface is not None:
        mesh = spec.add_mesh(name=f"{name}.surface")
        points, faces = np.unique(surface.reshape(-1, 3), axis=0, return_inverse=True)
        mesh.uservert, mesh.userface = points.ravel(), faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=[*color, 1.0], contype=0, conaffinity=0,
                      mass=0.0)


def add_gripper(spec: mujoco.MjSpec, shape: HandShape) -> None:
    """Add the hand, a mocap body `target` that it is welded to, and two driven fingers tied to each other.

    The frame of the hand is the closing frame. Fingers slide by half the width from closed.
    """
    spec.worldbody.add_body(name="target", mocap=True)
    hand = spec.worldbody.add_body(name=HAND, gravcomp=1.0)
    hand.add_freejoint(name=HAND)
    boxes = shape.table[-1]
    _add_boxes(hand, "palm", boxes[~shape.finger], HAND_MASS)
    side = np.where(boxes.mean(axis=1)[:, 1] > 0, 0, 1)
    for number, (name, sign) in enumerate(zip(FINGERS, (1.0, -1.0), strict=True)):
        finger = hand.add_body(name=name, gravcomp=1.0)
        finger.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0.0, sign, 0.0],
                         range=[0.0, shape.max_width / 2], limited=True, solref_limit=[0.004, 1.0], armature=0.05)
        closed = boxes[shape.finger & (side == number)] - [0.0, sign * shape.max_width / 2, 0.0]
        _add_boxes(finger, name, closed, FINGER_MASS)
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True,
                                     forcerange=[-20.0, 20.0])
        actuator.set_to_position(kp=STIFFNESS, kv=DAMPING)
    tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=FINGERS[0], name2=FINGERS[1], solref=[0.004, 1.0])
    tie.data[:5] = 0.0, 1.0, 0.0, 0.0, 0.0
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, name1="target", name2=HAND, solref=WELD,
                             objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.data[:11] = [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1.0]


def _add_boxes(body: Any, name: str, boxes: Array, mass: float) -> None:
    """Add boxes (n, 2, 3) of a total mass [kg] to a body of the gripper."""
    for number, (low, high) in enumerate(boxes):
        geom = body.add_geom(name=f"{name}.{number}", type=mujoco.mjtGeom.mjGEOM_BOX, size=(high - low) / 2,
                             pos=(low + high) / 2, mass=mass / len(boxes))
        _set_contact(geom, TOOL, SURFACE_FRICTION)
        geom.priority = int(name in FINGERS)


def _set_contact(geom: Any, kind: int, friction: float) -> None:
    geom.contype, geom.conaffinity = kind, {OBJECT: OBJECT, FIXED: OBJECT | TOOL, TOOL: OBJECT}[kind]
    geom.condim, geom.solref = CONDIM, SOLREF
    geom.friction = (friction, TORSION, ROLLING)
    if kind == TOOL:
        geom.group = TOOL_GROUP


def pose_to_qpos(T: Array) -> Array:
    """(7,) position and quaternion w, x, y, z of a pose (4, 4)."""
    x, y, z, w = matrix_to_quaternion(T[:3, :3])
    return np.array([*T[:3, 3], w, x, y, z])


def qpos_to_pose(qpos: Array) -> Array:
    """(4, 4) pose of a position and quaternion w, x, y, z (7,)."""
    px, py, pz, w, x, y, z = (float(value) for value in qpos)
    return transform(quaternion_to_matrix(x, y, z, w), (px, py, pz))
