"""Render the physics world with light, shadow and the arms: by OpenGL, or by ray casting without it.

Pixel values are proportional to light and use their full range: `level` is the light of the value 255, and a sensor
(`common/sim/sensors.py`) applies the exposure.

Nothing in the rendered model has mass or contact; links and objects are set to published poses. The dynamics model in
`model.py` has coarser shapes.
"""

from __future__ import annotations

import ctypes
import logging
import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Scenery, Surroundings
from common.messages import JointState, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion, pose_to_matrix
from common.sim.objects import Solid, appearance_of, solid_of_message
from common.sim.ray_caster import View
from common.sim.rendering import STILL_POSE, all_positions, link_poses, same_positions
from common.sim.sensors import CUTOFF, ambient, lamps, tint, white_level
from common.sim.table import tables
from drivers.mujoco.gl import FAR, Canvas, SingleThread
from drivers.mujoco.robot import cached_visual_meshes
from drivers.mujoco.scene import add_surroundings

Array = NDArray[np.float64]

log = logging.getLogger(__name__)
logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)  # irrelevant here, but logged every time


class PhysicsRenderer:
    """Renders one camera: see `common.sim.interface.Renderer`."""

    needs_arm = True

    def __init__(
        self, around: Surroundings, scenery: Scenery, robots: Sequence[RobotModel], camera: Pinhole, *, depth: bool,
        gl: str,
    ) -> None:
        """Prepare; nothing is rendered yet.

        Args:
            around: fixtures and containers.
            scenery: the light.
            robots: their visual meshes are shown.
            camera: intrinsics and pose.
            depth: compute depth; otherwise it is inf.
            gl: `egl`, `osmesa`, or empty for ray casting: see `gl.select_gl`.

        Raises:
            ConfigError: a mesh of the robot is missing.
        """
        self.camera = camera
        self._around, self._robots, self._depth = around, robots, depth
        self._gl = gl
        self._thread = SingleThread("renderer")
        self._canvas: Canvas | None = None
        self._drawn: DrawnModel | None = None
        self._view: View | None = None
        self._objects: list[WorldObject] = []
        self._joints: Array = np.empty(0)
        self.set_light(scenery)

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery."""
        self._scenery = scenery.model_copy()
        self.level = np.maximum(white_level(scenery), 1e-3)
        self._view = None

    def move_camera(self, camera: Pinhole) -> None:
        """Move the camera; its intrinsics stay."""
        if not np.allclose(camera.T_world_optical, self.camera.T_world_optical, rtol=0, atol=STILL_POSE):
            self.camera, self._view = camera, None

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Always True: rendering may take long."""
        return True

    def render(self, objects: Sequence[WorldObject], *joints: JointState | None) -> View:
        """Return the view of the objects, not of those "elsewhere", and of the arms in these states."""
        visible = [obj for obj in objects if obj.state != "elsewhere"]
        positions = all_positions(joints)
        if self._view is not None and visible == self._objects and same_positions(positions, self._joints):
            return self._view
        self._objects, self._joints = visible, positions
        self._view = self._thread(self._draw, visible, joints)
        return self._view

    def _draw(self, objects: list[WorldObject], joints: Sequence[JointState | None]) -> View:
        appearances = tuple(appearance_of(obj) for obj in objects)
        if self._drawn is None or self._drawn.appearances != appearances:
            self._drawn = DrawnModel(self._around, self._robots, objects, self.camera)
            if self._canvas is not None:
                self._canvas.close()
            self._canvas = self._new_canvas(self._drawn.model)
        self._drawn.put(objects, [link_poses(*each) for each in zip(self._robots, joints, strict=False)])
        if self._canvas is None:
            return ray_view(self._drawn.model, self._drawn.data, self.camera, self._scenery, self.level, FAR)
        return self._canvas.draw(self._drawn.data, self.camera, self._scenery, self.level, depth=self._depth)

    def _new_canvas(self, model: mujoco.MjModel) -> Canvas | None:
        if not self._gl:
            return None
        try:
            return Canvas(model, self.camera, self._gl)
        except (ImportError, RuntimeError, AttributeError, ctypes.ArgumentError) as error:  # all by PyOpenGL
            log.warning("images are ray-cast, without shadows: OpenGL (%s) fails: %s", self._gl, error)
            self._gl = ""
            return None


def ray_view(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Pinhole, scenery: Scenery, level: Array, far: float
) -> View:
    """Ray-cast view of a model with diffuse lighting and no shadows.

    Args:
        model: the model.
        data: its state, with kinematics computed.
        camera: intrinsics and pose.
        scenery: the light.
        level: (3,) [lx] of blue, green and red light for the value 255.
        far: length of rays [m].
    """
    v, u = np.mgrid[0:camera.height, 0:camera.width]
    rays = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    count = len(rays)
    geoms, distances, found = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros(3 * count)
    all_groups, eye = np.ones(mujoco.mjNGROUP, np.uint8), camera.position
    mujoco.mj_multiRay(model, data, eye, rays.ravel(), all_groups, True, -1, geoms, distances, found, count, far)
    hit, normals = geoms >= 0, found.reshape(-1, 3)
    normals *= np.where(np.sum(normals * rays, axis=1) > 0, -1.0, 1.0)[:, None]  # facing the camera
    points = camera.position + distances[:, None] * rays
    light = np.broadcast_to(ambient(scenery), (count, 3)).copy()
    for lamp in lamps(scenery):
        direction = np.subtract(lamp.aim, lamp.position)
        length = float(np.linalg.norm(direction)) or 1.0
        if lamp.parallel:
            towards, strength = np.broadcast_to(-direction / length, points.shape), np.ones(count)
        else:
            towards = np.asarray(lamp.position) - points
            distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
            towards = towards / distance[:, None]
            inside = -(towards @ direction) / length >= math.cos(math.radians(CUTOFF))
            strength = inside * (length / distance) ** 2
        facing = np.maximum(np.sum(normals * towards, axis=1), 0.0) * strength
        light += facing[:, None] * (lamp.illuminance * tint(lamp.temperature))
    colours = np.zeros((count, 3))
    colours[hit] = np.asarray(model.geom_rgba)[geoms[hit], 2::-1]
    colour = np.where(hit[:, None], np.clip(255 * colours * light / level, 0, 255), 0)
    along = np.asarray(rays @ camera.T_world_optical[:3, 2])
    depth = np.where(hit, distances * along, np.inf)
    shape = (camera.height, camera.width)
    return View(np.rint(colour).astype(np.uint8).reshape(*shape, 3), depth.astype(np.float32).reshape(shape))


TRIANGLES = 25_000  # of each robot
AWAY = (0.0, 0.0, -100.0)  # [m] of links before the first joint state
SHADOW_MAP = 1024  # [px] side; MuJoCo's default 4096 takes three times as long as the image
SHADOW_REACH = 1.2  # [m] half side of the shadowed square around the aim of parallel light
EXTENT = 1.0  # [m] unit of MuJoCo's view lengths
SIDES = 48  # of round shapes


class DrawnModel:
    """Compiled model of fixtures, robots and objects, whose bodies can be moved.

    Attributes:
        model, data: MuJoCo's; current after `put`.
    """

    def __init__(
        self, around: Surroundings, robots: Sequence[RobotModel], objects: Sequence[WorldObject], camera: Pinhole
    ) -> None:
        """Build the model for images of the camera's size.

        Raises:
            ConfigError: a mesh of the robot is missing.
        """
        spec = mujoco.MjSpec()
        _set_quality(spec, camera)
        add_surroundings(spec, around)
        _cast_no_shadow(spec, around)
        self._links = [self._add_robot(spec, number, robot) for number, robot in enumerate(robots)]
        self.appearances = tuple(appearance_of(obj) for obj in objects)
        for number, obj in enumerate(objects):
            _add_object(spec, number, obj)
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._at = {self.model.body(number).name: int(self.model.body_mocapid[number])
                    for number in range(self.model.nbody) if self.model.body_mocapid[number] >= 0}
        mujoco.mj_forward(self.model, self.data)

    def put(self, objects: Sequence[WorldObject], links: Sequence[Mapping[str, Array] | None]) -> None:
        """Move the objects, in the order of construction, and the links.

        Args:
            objects: of the same appearance.
            links: of each robot, (4, 4) poses in world by name; None leaves it unchanged.
        """
        for number, obj in enumerate(objects):
            self._set(f"object:{number}", pose_to_matrix(obj.pose))
        for robot, (names, poses) in enumerate(zip(self._links, links, strict=False)):
            for name in names:
                if poses is not None:
                    self._set(f"link:{robot}:{name}", poses[name])
        mujoco.mj_kinematics(self.model, self.data)

    def _set(self, body: str, T: Array) -> None:
        x, y, z, w = matrix_to_quaternion(T[:3, :3])
        self.data.mocap_pos[self._at[body]] = T[:3, 3]
        self.data.mocap_quat[self._at[body]] = (w, x, y, z)

    def _add_robot(self, spec: mujoco.MjSpec, at: int, robot: RobotModel) -> list[str]:
        """Add a robot by its number; return the links that are visible."""
        links: list[str] = []
        for number, piece in enumerate(cached_visual_meshes(robot, TRIANGLES)):
            body = spec.body(f"link:{at}:{piece.link}")
            if body is None:
                body = spec.worldbody.add_body(name=f"link:{at}:{piece.link}", mocap=True, pos=AWAY)
                links.append(piece.link)
            mesh = spec.add_mesh(name=f"seen:{at}:{number}")
            mesh.uservert, mesh.userface = piece.vertices.ravel(), piece.faces.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name,
                          rgba=[*(part / 255 for part in piece.color), 1.0])
        return links


def _set_quality(spec: mujoco.MjSpec, camera: Pinhole) -> None:
    """Set rendering quality."""
    spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6
    spec.stat.extent = EXTENT
    quality = spec.visual.quality
    quality.shadowsize, quality.offsamples = SHADOW_MAP, 4
    quality.numslices, quality.numstacks, quality.numquads = SIDES, SIDES // 2, 8
    spec.visual.headlight.active = 0
    spec.visual.map.shadowclip, spec.visual.map.shadowscale = SHADOW_REACH / EXTENT, 1.0
    size = spec.visual.global_
    size.offwidth, size.offheight = camera.width, camera.height


def _cast_no_shadow(spec: mujoco.MjSpec, around: Surroundings) -> None:
    """Exclude floor and tables from the shadow map, whose rounding would stain them."""
    spec.geom("floor").castshadow = False
    for table in tables(around):
        spec.geom(f"fixture:{table.id}").castshadow = False


def _add_object(spec: mujoco.MjSpec, number: int, obj: WorldObject) -> None:
    body, kinds, solid = spec.worldbody.add_body(name=f"object:{number}", mocap=True), mujoco.mjtGeom, \
        solid_of_message(obj)
    rgba = [obj.color.r, obj.color.g, obj.color.b, 1.0]
    if solid.shape == "sphere":
        body.add_geom(type=kinds.mjGEOM_SPHERE, size=[solid.radius, 0.0, 0.0], rgba=rgba)
    elif solid.shape == "box":
        size, middle = (solid.high - solid.low) / 2, (solid.low + solid.high) / 2
        body.add_geom(type=kinds.mjGEOM_BOX, size=size, pos=middle, rgba=rgba)
    else:
        mesh = spec.add_mesh(name=f"object:{number}")
        vertices, faces = _indexed(solid)
        mesh.uservert, mesh.userface = vertices.ravel(), faces.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        body.add_geom(type=kinds.mjGEOM_MESH, meshname=mesh.name, rgba=rgba)


def _indexed(solid: Solid) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (n, 3) [m] and outward faces (m, 3) of a solid, one vertex per position and face normal.

    MuJoCo averages the normals of the faces at a vertex, which would smooth edges.
    """
    triangles = np.array(solid.triangles, float)
    if solid.shape != "mesh":  # mesh files define orientation; flip the lower face and hole of a prism
        low = len(triangles) // 2 - len(solid.section) - len(solid.hole)
        for inward in (slice(0, low), slice(len(triangles) - 2 * len(solid.hole), None)):
            triangles[inward] = triangles[inward, ::-1]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normals, axis=1)
    nonzero = length > 1e-12  # [m^2]
    triangles, normals = triangles[nonzero], normals[nonzero] / length[nonzero, None]
    keyed = np.concatenate([triangles.reshape(-1, 3), np.repeat(np.round(normals, 2) + 0.0, 3, axis=0)], axis=1)
    unique, index = np.unique(keyed, axis=0, return_inverse=True)
    return unique[:, :3], index.reshape(-1, 3).astype(np.int32)
