"""Add objects, fixtures, containers, floor and cameras to a MuJoCo spec, with their contact parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import CameraConfig, Container, Fixture, SuctionCup, Surroundings
from common.config.world import TCP
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion, rpy_to_matrix
from common.sim.footprints import convex_parts
from common.sim.objects import Solid
from common.sim.resting import FLOOR_BELOW_TABLE
from common.sim.suction import lip
from drivers.mujoco import ROLLING
from drivers.mujoco.decomposition import mesh_pieces, points_and_volume

Array = NDArray[np.float64]

RING_PIECES = 16  # convex pieces of a ring
DEFAULT_MASS = 0.1  # [kg]


@dataclass(frozen=True, eq=False)
class SceneObject:
    """An object: shape in its own frame, color, mass [kg], and friction, by default that of the other surface."""

    id: str
    solid: Solid
    color: tuple[float, float, float]
    mass: float = DEFAULT_MASS
    friction: float | None = None


def add_object(spec: mujoco.MjSpec, obj: SceneObject) -> None:
    """Add an object: a free body `object:ID` at the origin."""
    body = spec.worldbody.add_body(name=f"object:{obj.id}")
    body.add_freejoint(name=f"object:{obj.id}")
    geoms = _geoms(spec, body, obj)
    volume = sum(volume for _, volume in geoms)
    for geom, part in geoms:
        geom.mass = obj.mass * part / volume
        geom.rgba = [*obj.color, 1.0]
        set_contact(geom, OBJECT)
        if obj.friction is not None:  # a rubber pad on a polished object slips like the object
            set_friction(geom, obj.friction)


def _geoms(spec: mujoco.MjSpec, body: Any, obj: SceneObject) -> list[tuple[Any, float]]:
    """Convex geoms, each with its volume [m^3]."""
    solid, kinds = obj.solid, mujoco.mjtGeom
    if solid.shape == "sphere":
        return [(body.add_geom(type=kinds.mjGEOM_SPHERE, size=[solid.radius, 0.0, 0.0]), 1.0)]
    if solid.shape in ("box", "cylinder"):
        size, center = solid.size / 2, (solid.low + solid.high) / 2
        if solid.shape == "box":
            return [(body.add_geom(type=kinds.mjGEOM_BOX, size=size, pos=center), 1.0)]
        return [(body.add_geom(type=kinds.mjGEOM_CYLINDER, size=[size[0], size[2], 0.0], pos=center), 1.0)]
    pieces = []
    for number, (points, volume) in enumerate(convex_pieces(solid, obj.id)):
        mesh = spec.add_mesh(name=f"object:{obj.id}.{number}")
        mesh.uservert = points.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        pieces.append((body.add_geom(type=kinds.mjGEOM_MESH, meshname=mesh.name), volume))
    return pieces


def convex_pieces(solid: Solid, name: str = "") -> list[tuple[Array, float]]:
    """Points (n, 3) [m] and volume [m^3] of convex pieces of a solid; `name` is for warnings.

    Concave prisms are split into triangles, rings into wedges, meshes as in `decomposition`.
    """
    if solid.shape == "mesh":
        return [points_and_volume(piece) for piece in mesh_pieces(solid.mesh, name)]
    heights = np.array([solid.low[2], solid.high[2]])
    if solid.shape == "ring":
        outer, inner = float(solid.high[0]), solid.inner_radius
        angles = np.linspace(0.0, 2 * math.pi, RING_PIECES + 1)
        sections = []
        for a, b in pairwise(angles):
            directions = np.array([[math.cos(t), math.sin(t)] for t in (a, (a + b) / 2, b)])
            sections.append(np.concatenate([outer * directions, inner * directions[::-2]]))
    else:
        sections = [np.asarray(part) for part in convex_parts(solid.section)]
    pieces = [np.concatenate([np.column_stack([section, np.full(len(section), z)]) for z in heights])
              for section in sections]
    return [(points, _volume(points)) for points in pieces]


def _volume(points: Array) -> float:
    """Approximate volume of a convex piece [m^3]: that of its bounding box suffices to distribute mass."""
    return float(np.prod(np.maximum(np.ptp(points, axis=0), 1e-6)))


# Contact parameters and collision filtering; docs/physics.md explains the values

TIMESTEP = 0.002  # [s]
IMPRATIO = 10.0  # friction stiffer than contact: held objects do not creep
SOLREF = (0.004, 1.0)  # time constant [s], damping; with MuJoCo's default 0.02 fingers sink 11 mm into objects
SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
SLIDING, TORSION = 1.0, 0.01  # coefficient, [m]
FINGER_SLIDING = 1.5  # rubber pads
CONDIM = 6  # sliding, torsion and rolling
FINGER_PRIORITY, OBJECT_PRIORITY = 1, 2  # the friction of the geom of higher priority applies; else the larger one

FIXED, OBJECT, HIDDEN = 2, 4, 0  # collision categories
ROBOT = 0x7FFFFFF9  # mask of the categories of arms, one for each: only the planner checks self-collision
_COLLIDES_WITH = {FIXED: ROBOT, OBJECT: ROBOT | FIXED | OBJECT, HIDDEN: 0}


def arm_category(number: int) -> int:
    """Return the collision category of an arm by its number."""
    return OBJECT << number if number else 1


# Geom groups for rendering: visual only, and collision only
SEEN, COLLIDES = 2, 3


def wxyz(rotation: Array) -> list[float]:
    """Quaternion w, x, y, z, as in MuJoCo, of a (3, 3) rotation."""
    x, y, z, w = matrix_to_quaternion(rotation)
    return [w, x, y, z]


def set_contact(geom: Any, kind: int, *, group: int = 0) -> Any:
    """Set the contact parameters of a category on a geom (of an MjSpec); return the geom."""
    others = _COLLIDES_WITH.get(kind, (kind - 1) & ROBOT)  # an arm: those of lower numbers
    geom.contype, geom.conaffinity, geom.group = kind, others, group
    geom.condim = CONDIM if kind == OBJECT else 3
    geom.friction, geom.solref, geom.solimp = (SLIDING, TORSION, ROLLING), SOLREF, SOLIMP
    return geom


def set_friction(geom: Any, sliding: float) -> None:
    """Set the coefficient of sliding friction of a geom against everything, also the pads of fingers."""
    geom.friction, geom.priority = (sliding, sliding * TORSION, ROLLING), OBJECT_PRIORITY


def set_finger_contact(geom: Any) -> Any:
    """Set the contact parameters of a finger pad, which override those of the object; return the geom."""
    geom.friction = (FINGER_SLIDING, TORSION, ROLLING)
    geom.condim, geom.priority = CONDIM, FINGER_PRIORITY
    return geom


def visual_only(geom: Any) -> Any:
    """Remove contact and mass from a geom; return it."""
    geom.contype = geom.conaffinity = HIDDEN
    geom.group, geom.mass, geom.density = SEEN, 0.0, 0.0
    return geom


LIP, LIP_RADIUS = "lip", 0.002  # name of the body and actuator of a suction cup; radius of its spheres [m]
SOFT = (0.01, 1.0)  # time constant [s] and damping of a rubber lip


def add_lip(spec: mujoco.MjSpec, tcp_link: str, cup: SuctionCup, category: int) -> None:
    """Add the lip of a suction cup, a ring of small spheres that protrude from the tool, and its adhesion actuator."""
    body = spec.body(tcp_link).add_body(name=LIP, gravcomp=1.0)
    for x, y in lip(cup)[1:]:
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[LIP_RADIUS, 0.0, 0.0], pos=[x, y, 0.0])
        set_finger_contact(set_contact(geom, category, group=COLLIDES))
        geom.mass, geom.solref = 1e-4, SOFT
        geom.gap = cup.give  # within it the cup pulls, without touching yet
    actuator = spec.add_actuator(name=LIP, target=LIP, trntype=mujoco.mjtTrn.mjTRN_BODY)
    actuator.set_to_adhesion(gain=cup.force)
    actuator.ctrlrange = [0.0, 1.0]


# Surroundings and cameras

MIN_HEIGHT = 0.3  # [m] smallest height of fixtures that reach the floor
BELT_INERTIA = 1e5  # [kg] of the drive: what lies on a belt does not slow it
FLOOR_COLOR = (0.62, 0.62, 0.60, 1.0)
_OPTICAL_TO_GL = np.diag([1.0, -1.0, -1.0])  # optical frame: z forward, y down; MuJoCo camera: -z forward, y up


def add_surroundings(spec: mujoco.MjSpec, world: Surroundings) -> None:
    """Add fixtures and containers, as bodies `fixture:ID` and `container:ID`, and the floor."""
    kinds = {"box": mujoco.mjtGeom.mjGEOM_BOX, "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
             "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
    for fixture in world.fixtures:
        body = spec.worldbody.add_body(name=f"fixture:{fixture.id}", pos=fixture.position,
                                       quat=wxyz(rpy_to_matrix(*fixture.rpy)))
        d = fixture.dimensions
        size = {"box": [side / 2 for side in d], "sphere": [d[0], 0.0, 0.0],
                "cylinder": [d[0], d[-1] / 2, 0.0]}[fixture.shape]
        if fixture.id in world.conveyors:
            _add_slide(body, f"belt:{fixture.id}")
        geom = body.add_geom(name=f"fixture:{fixture.id}", type=kinds[fixture.shape], size=size,
                             rgba=[*fixture.color, 1.0])
        set_contact(geom, FIXED)
        if fixture.friction is not None:
            set_friction(geom, fixture.friction)
    for container in world.containers.values():
        _add_container(spec, container, world.table_height)
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5.0, 5.0, 0.1],
                                    pos=[0.0, 0.0, floor_height(world)], rgba=FLOOR_COLOR)
    set_contact(floor, FIXED)


def _add_slide(body: Any, name: str) -> None:
    """Let a body slide along its own x axis, as the surface of a belt: see `drivers.mujoco.belts`."""
    slide = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1.0, 0.0, 0.0])
    slide.armature = BELT_INERTIA


def floor_height(world: Surroundings) -> float:
    """z of the floor [m]: bottom of the fixtures, or below the table."""
    extents = [_extent(fixture) for fixture in world.fixtures]
    top, bottom = max((high for _, high in extents), default=0.0), min((low for low, _ in extents), default=0.0)
    return bottom if top - bottom > MIN_HEIGHT else min(bottom, world.table_height) - FLOOR_BELOW_TABLE


def _extent(fixture: Fixture) -> tuple[float, float]:
    """Conservative height range [m] of a fixture."""
    d, up = fixture.dimensions, np.abs(rpy_to_matrix(*fixture.rpy)[2])
    half = {"box": float(up @ np.resize(d, 3)) / 2, "sphere": d[0],
            "cylinder": float(up[2] * d[-1] / 2 + math.hypot(up[0], up[1]) * d[0])}[fixture.shape]
    return fixture.position[2] - half, fixture.position[2] + half


def _add_container(spec: mujoco.MjSpec, c: Container, table: float) -> None:
    """Add five panels: a floor and walls on the table."""
    body = spec.worldbody.add_body(name=f"container:{c.id}", pos=[c.x, c.y, table])
    half, thick, center = c.half_side, c.wall_thickness / 2, c.wall_height / 2
    off = half - thick
    panels = [((0.0, 0.0, c.floor_thickness / 2), (half, half, c.floor_thickness / 2))]
    panels += [((sign * off, 0.0, center), (thick, half, center)) for sign in (-1, 1)]
    panels += [((0.0, sign * off, center), (half - 2 * thick, thick, center)) for sign in (-1, 1)]
    for number, (at, size) in enumerate(panels):
        geom = body.add_geom(name=f"container:{c.id}.{number}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=at, size=size,
                             rgba=[*c.color, 1.0])
        set_contact(geom, FIXED)


def add_cameras(spec: mujoco.MjSpec, world: Surroundings, robot: RobotModel, prefix: str) -> None:
    """Add the cameras of the world by name, on their mounts; names of the robot's links begin with `prefix`."""
    for name, camera in world.cameras.items():
        body: Any = spec.worldbody
        if camera.mount:
            body = spec.body(prefix + (robot.config.tcp_link if camera.mount == TCP else camera.mount))
        body.add_camera(name=name, pos=camera.position, quat=camera_quaternion(rpy_to_matrix(*camera.rpy)),
                        fovy=field_of_view(camera), resolution=[camera.width, camera.height])


def camera_quaternion(rotation: NDArray[np.float64]) -> list[float]:
    """w, x, y, z of a MuJoCo camera whose optical frame has this (3, 3) rotation."""
    return wxyz(rotation @ _OPTICAL_TO_GL)


def field_of_view(camera: CameraConfig) -> float:
    """Vertical field of view [deg]; ignores the principal point and non-square pixels."""
    return math.degrees(2 * math.atan(camera.height / (2 * camera.fy)))
