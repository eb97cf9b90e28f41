"""MuJoCo model for rendering: fixtures, visual meshes of the robot, and objects in their exact shapes.

Nothing in it has mass or contact; links and objects are set to published poses. The dynamics model in `model.py` has
coarser shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import Surroundings
from common.messages import WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion, pose_to_matrix
from common.sim.objects import Solid, appearance_of, solid_of_message
from common.sim.table import tables
from drivers.mujoco.mesh_cache import cached_visual_meshes
from drivers.mujoco.scene import add_surroundings

Array = NDArray[np.float64]

TRIANGLES = 25_000  # of the robot
AWAY = (0.0, 0.0, -100.0)  # [m] of links before the first joint state
SHADOW_MAP = 1024  # [px] side; MuJoCo's default 4096 takes three times as long as the image
SHADOW_REACH = 1.2  # [m] half side of the shadowed square around the aim of parallel light
EXTENT = 1.0  # [m] unit of MuJoCo's view lengths
SIDES = 48  # of round shapes


class DrawnModel:
    """Compiled model of fixtures, robot and objects, whose bodies can be moved.

    Attributes:
        model, data: MuJoCo's; current after `put`.
    """

    def __init__(
        self, around: Surroundings, robot: RobotModel | None, objects: Sequence[WorldObject], camera: Pinhole
    ) -> None:
        """Build the model for images of the camera's size.

        Raises:
            ConfigError: a mesh of the robot is missing.
        """
        spec = mujoco.MjSpec()
        _set_quality(spec, camera)
        add_surroundings(spec, around)
        _cast_no_shadow(spec, around)
        self._links: list[str] = []
        if robot is not None:
            self._add_robot(spec, robot)
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

    def put(self, objects: Sequence[WorldObject], links: Mapping[str, Array] | None) -> None:
        """Move the objects, in the order of construction, and the links.

        Args:
            objects: of the same appearance.
            links: (4, 4) poses in world by name; None leaves the arm unchanged.
        """
        for number, obj in enumerate(objects):
            self._set(f"object:{number}", pose_to_matrix(obj.pose))
        if links is not None:
            for name in self._links:
                self._set(f"link:{name}", links[name])
        mujoco.mj_kinematics(self.model, self.data)

    def _set(self, body: str, T: Array) -> None:
        x, y, z, w = matrix_to_quaternion(T[:3, :3])
        self.data.mocap_pos[self._at[body]] = T[:3, 3]
        self.data.mocap_quat[self._at[body]] = (w, x, y, z)

    def _add_robot(self, spec: mujoco.MjSpec, robot: RobotModel) -> None:
        for number, piece in enumerate(cached_visual_meshes(robot, TRIANGLES)):
            body = spec.body(f"link:{piece.link}")
            if body is None:
                body = spec.worldbody.add_body(name=f"link:{piece.link}", mocap=True, pos=AWAY)
                self._links.append(piece.link)
            mesh = spec.add_mesh(name=f"seen:{number}")
            mesh.uservert, mesh.userface = piece.vertices.ravel(), piece.faces.ravel()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name,
                          rgba=[*(part / 255 for part in piece.color), 1.0])


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
