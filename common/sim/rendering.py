"""Render what cameras see of the simulated world: fixtures, containers, objects and the arm.

A full image shows solid geometry with color and depth by ray casting. A plain image has a grey table with a grid and
containers as edges, and omits the arm and the held object unless a robot is passed; its spheres are exact and take a
few tenths of a millisecond in total.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from common.config import Container, Scenery, Surroundings
from common.messages import JointState, WorldObject
from common.perception.pinhole import Pinhole, silhouette
from common.robot.transforms import pose_to_matrix
from common.scene.fixtures import container_panels
from common.sim.objects import appearance_of, solid_of_message
from common.sim.ray_caster import Mesh, View, cast, empty_view
from common.sim.sensors import white_level
from common.sim.solids import fixture_mesh, primitive, transformed
from common.sim.table import tables

if TYPE_CHECKING:  # most images show no arm
    from common.robot.model import RobotModel

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

GROUND = (178 / 255, 178 / 255, 178 / 255)  # of a full image
ARM = (0.55, 0.55, 0.55)
FEW = 32  # spheres that are drawn without delay
STILL = 1e-4  # [rad] smaller joint motion does not change the image
STILL_POSE = 1e-6  # [m] and rotation entries: smaller camera motion does not change it
BASE = 128  # grey of a plain image
GRID = 108
GRID_SPACING = 40  # [px]
RIM = (255, 255, 255)
RIM_WIDTH = 2  # [px]
_SHIFT = 4  # fractional bits of coordinates for OpenCV: 1/16 px


class Renderer:
    """Renders one camera. Rays are cast only for what changed: static geometry once, the arm when it moves."""

    def __init__(
        self, around: Surroundings, *robots: RobotModel, plain: bool = False,
        camera: Pinhole | None = None, rim_width: float = RIM_WIDTH, scenery: Scenery | None = None,
    ) -> None:
        """Render the background.

        Args:
            around: fixtures and containers, and the default camera.
            robots: shown if given.
            plain: render plain images.
            camera: intrinsics and pose of the optical frame.
            rim_width: of the white outline of each sphere in a plain image [px]; 0 for none.
            scenery: the light. It is uniform: only its brightness and color matter.

        Raises:
            ConfigError: a mesh of the robot is missing.
        """
        self.camera = camera if camera is not None else Pinhole.from_config(around.camera)
        self.needs_arm = bool(robots)
        self.set_light(scenery or Scenery())
        self._plain, self._rim_width, self._around = plain, rim_width, around
        self._robots = [(robot, _shapes_of(robot)) for robot in robots]
        self._meshes: dict[tuple[object, ...], Array] = {}  # triangles of visible objects, in their own frames
        self._static_meshes = [] if plain else _static_meshes(around)
        self._last_request: Sequence[WorldObject] | None = None
        self._objects: list[WorldObject] | None = None
        self._joints: Array = np.empty(0)
        # Of the last plain image, by center and radius.
        self._spheres: dict[tuple[float, ...], SphereCoverage | None] = {}
        self._draw_background()

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery; it affects exposure only."""
        self.level = white_level(scenery)

    def move_camera(self, camera: Pinhole) -> None:
        """Move the camera; everything is rendered again."""
        if camera.T_world_optical is self.camera.T_world_optical or np.allclose(
                camera.T_world_optical, self.camera.T_world_optical, rtol=0, atol=STILL_POSE):
            return
        self.camera, self._last_request, self._objects, self._spheres = camera, None, None, {}
        self._draw_background()

    def _draw_background(self) -> None:
        self._background = self._plain_background(self._around) if self._plain else empty_view(self.camera, GROUND)
        self._deep = bool(np.isfinite(self._background.depth).any())  # the background may occlude a sphere
        self._static_view = self._view = self._background

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Whether rendering the objects may take long: everything but a few spheres is ray-cast."""
        slow = len(objects) > FEW or any(obj.shape != "sphere" for obj in objects)
        return self.needs_arm or (slow and objects != self._last_request)

    def render(self, objects: Sequence[WorldObject], *joints: JointState | None) -> View:
        """Return the view of the objects, and of each arm if its joint state is complete.

        The depth of a plain image contains neither table nor spheres. Objects in state "elsewhere" are not shown.
        """
        self._last_request = objects
        occluded = ("held", "elsewhere") if self._plain and not self.needs_arm else ("elsewhere",)
        visible = [obj for obj in objects if obj.state not in occluded]
        changed = self._objects is None or visible != self._objects
        if changed:
            self._objects = visible
            self._static_view = self._with_objects(visible, [])
        positions = all_positions(joints)
        if changed or not same_positions(positions, self._joints):
            self._joints = positions
            arm = self._arms(joints)
            if arm and self._plain:  # spheres are drawn last
                self._view = self._with_objects(visible, arm)
            else:
                self._view = cast(arm, self.camera, self._static_view) if arm else self._static_view
        return self._view

    @property
    def cached_shapes(self) -> int:
        """Number of cached shapes: those of visible objects."""
        return len(self._meshes)

    def _plain_background(self, around: Surroundings) -> View:
        """Table, fixtures and containers of a plain image."""
        tops = tables(around)
        view = empty_view(self.camera, (BASE / 255,) * 3)
        view.colour[::GRID_SPACING] = GRID
        view.colour[:, ::GRID_SPACING] = GRID
        fixtures = [fixture_mesh(fixture) for fixture in around.fixtures if fixture not in tops]
        view = cast(fixtures, self.camera, view) if fixtures else view
        for container in around.containers.values():
            _draw_container(view.colour, self.camera, container, around.table_height)
        return view

    def _with_objects(self, objects: Sequence[WorldObject], arm: list[Mesh]) -> View:
        spheres = [obj for obj in objects if self._plain and obj.shape == "sphere"]
        others = [obj for obj in objects if not (self._plain and obj.shape == "sphere")]
        cache, self._meshes = self._meshes, {}  # only visible objects: clients may publish any number of shapes
        solid = [*self._static_meshes, *(self._mesh(obj, cache) for obj in others), *arm]
        plain = View(self._background.colour.copy(), self._background.depth)
        view = cast(solid, self.camera, self._background) if solid else plain
        distances = [float(np.linalg.norm(_centre(obj) - self.camera.position)) for obj in spheres]
        occluded, before, self._spheres = self._deep or bool(solid), self._spheres, {}
        for index in sorted(range(len(spheres)), key=lambda i: -distances[i]):  # farthest first
            obj = spheres[index]
            key = *_centre(obj).tolist(), obj.size.x / 2
            coverage = before[key] if key in before else sphere_coverage(
                self.camera, _centre(obj), obj.size.x / 2, self._rim_width)
            self._spheres[key] = coverage
            if coverage is not None:
                _draw_sphere(view, coverage, _bgr(obj), occluded=occluded)
        return view

    def _mesh(self, obj: WorldObject, cache: Mapping[tuple[object, ...], Array]) -> Mesh:
        appearance = appearance_of(obj)
        if appearance not in self._meshes:
            self._meshes[appearance] = cache[appearance] if appearance in cache else solid_of_message(obj).triangles
        color = (obj.color.r, obj.color.g, obj.color.b)
        return Mesh(transformed(self._meshes[appearance], pose_to_matrix(obj.pose)), color)

    def _arms(self, joints: Sequence[JointState | None]) -> list[Mesh]:
        return [
            Mesh(transformed(corners, poses[link]), ARM)
            for (robot, shapes), state in zip(self._robots, joints, strict=False)
            if (poses := link_poses(robot, state)) is not None for link, corners in shapes.items()
        ]


def _shapes_of(robot: RobotModel) -> dict[str, Array]:
    from common.sim.solids import robot_shapes

    return robot_shapes(robot)


def link_poses(robot: RobotModel, joints: JointState | None) -> Mapping[str, Array] | None:
    """(4, 4) pose of each link in world, fingers included; None if the state lacks a joint of the arm."""
    q = robot.order(joints.name, joints.position) if joints is not None else None
    if q is None or joints is None:
        return None
    others = {name: value for name, value in zip(joints.name, joints.position, strict=True)
              if name in robot.config.locked_joints}
    return robot.link_poses(q, others)


def _static_meshes(around: Surroundings) -> list[Mesh]:
    """Fixtures and the panels of containers."""
    panels = [panel for box in around.containers.values() for panel in container_panels(box, around.table_height)]
    return [
        *(fixture_mesh(fixture) for fixture in around.fixtures),
        *(Mesh(transformed(primitive("box", panel.dimensions), pose_to_matrix(panel.pose)),
               (panel.color.r, panel.color.g, panel.color.b)) for panel in panels),
    ]


def draw(
    objects: Sequence[WorldObject], camera: Pinhole, around: Surroundings, *, noise_std: float = 0.0,
    brightness: float = 0.0, rng: np.random.Generator | None = None, rim_width: float = RIM_WIDTH,
) -> Pixels:
    """Render one plain image, bgr8 (height, width, 3); see `Renderer` and `add_image_noise`."""
    image = Renderer(around, plain=True, camera=camera, rim_width=rim_width).render(objects).colour
    return add_image_noise(image, noise_std, brightness, rng)


def add_image_noise(
    image: Pixels, noise_std: float, brightness: float, rng: np.random.Generator | None = None
) -> Pixels:
    """Image with Gaussian noise of a standard deviation, and a brightness offset in each channel."""
    if noise_std <= 0 and brightness == 0:
        return image
    values = image.astype(np.float32)
    if noise_std > 0:
        generator = rng if rng is not None else np.random.default_rng(0)
        values += generator.standard_normal(image.shape, dtype=np.float32) * np.float32(noise_std)
    values += np.float32(brightness)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def add_depth_noise(depth: Depth, rng: np.random.Generator, noise_std: float, dropout: float) -> Depth:
    """Depth image with Gaussian noise [m], and NaN in a random fraction of pixels."""
    measured = depth
    if noise_std > 0:
        measured = measured + np.float32(noise_std) * rng.standard_normal(depth.shape, dtype=np.float32)
    if dropout > 0:
        measured = np.where(rng.random(depth.shape, dtype=np.float32) < dropout, np.float32(np.nan), measured)
    return measured


@dataclass(frozen=True)
class SphereCoverage:
    """Coverage of a sphere within columns and rows `low` to `high` of an image; arrays are (rows, columns, 1)."""

    low: npt.NDArray[np.int_]
    high: npt.NDArray[np.int_]
    rim: Array  # coverage by the outline
    inner: Array  # coverage by the interior
    near: Array  # depth [m]


def sphere_coverage(camera: Pinhole, center: Array, radius: float, rim_width: float) -> SphereCoverage | None:
    """Coverage of each pixel by a sphere; None if it is not visible.

    The rim straddles the outline. Filled polygons in OpenCV are half a pixel too large all around, as much as the total
    error of a good fit; the distance of a pixel from the outline is exact.
    """
    outline = silhouette(camera, center, radius, 32)
    if not len(outline):
        return None
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 4 - int(rim_width), 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 5 + int(rim_width), (camera.width, camera.height))
    if (high - low < 2).any():
        return None
    x, y, z = camera.to_camera(center)
    a = ((np.arange(low[0], high[0]) - camera.cx) / camera.fx)[None, :]
    b = ((np.arange(low[1], high[1]) - camera.cy) / camera.fy)[:, None]
    along = (x * a + y * b + z) ** 2 / (1 + a * a + b * b)
    away = np.maximum(x * x + y * y + z * z - along, 0.0)  # squared distance of rays from the center [m^2]
    beyond = np.sqrt(away) - radius  # distance of rays from the sphere [m]
    slope = np.hypot(*np.gradient(beyond))  # [m/px]
    outside = beyond / np.maximum(slope, 1e-9)  # [px]
    near = (np.sqrt(along) - np.sqrt(np.maximum(radius**2 - away, 0.0))) / np.sqrt(1 + a * a + b * b)
    rim = np.clip(0.5 + rim_width / 2 - outside, 0, 1) if rim_width else np.zeros_like(outside)
    inner = np.clip(0.5 - rim_width / 2 - outside, 0, 1)
    return SphereCoverage(low, high, rim[..., None], inner[..., None], near[..., None])


def _draw_sphere(view: View, sphere: SphereCoverage, color: tuple[int, int, int], *, occluded: bool) -> None:
    """Blend a sphere into the image; with `hidden`, nearer depth in the view occludes it."""
    (left, top), (right, bottom) = sphere.low, sphere.high
    weight: float | npt.NDArray[np.float32] = 1.0
    if occluded:
        weight = (sphere.near < view.depth[top:bottom, left:right, None]).astype(np.float32)
    cut = view.colour[top:bottom, left:right]
    blended = cut.astype(np.float32)
    for part, paint in ((sphere.rim, RIM), (sphere.inner, color)):
        blended += weight * part * (np.array(paint, np.float32) - blended)
    cut[...] = np.rint(blended).astype(np.uint8)


def _draw_container(image: Pixels, camera: Pinhole, container: Container, table_height: float) -> None:
    """Draw the outer edges of a container: rim, base and the four corners between them."""
    h = container.half_side
    corners = np.array([(container.x + dx, container.y + dy) for dx, dy in ((-h, -h), (h, -h), (h, h), (-h, h))])
    rings = []
    for z in (table_height, table_height + container.wall_height):
        ring = camera.project(np.column_stack([corners, np.full(4, z)]))
        if not np.isfinite(ring).all():
            return
        rings.append(_fixed_point(ring))
    edges = [np.array([low, high]) for low, high in zip(*rings, strict=True)]
    r, g, b = (round(255 * value) for value in container.color)
    cv2.polylines(image, edges, False, (b, g, r), 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(image, rings[:1], True, (b, g, r), 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(image, rings[1:], True, (b, g, r), 2, cv2.LINE_AA, _SHIFT)


def _fixed_point(pixels: Array) -> npt.NDArray[np.int32]:
    """Fixed-point coordinates for OpenCV, clipped far outside the image."""
    return np.rint(np.clip(pixels, -4000, 20000) * (1 << _SHIFT)).astype(np.int32)


def _centre(obj: WorldObject) -> Array:
    p = obj.pose.position
    return np.array([p.x, p.y, p.z])


def _bgr(obj: WorldObject) -> tuple[int, int, int]:
    r, g, b = (round(255 * value) for value in (obj.color.r, obj.color.g, obj.color.b))
    return b, g, r


def all_positions(joints: Sequence[JointState | None]) -> Array:
    """Positions of the joints of all arms, for `same_positions`."""
    return np.array([position for state in joints if state is not None for position in state.position])


def same_positions(a: Array, b: Array) -> bool:
    """Whether no joint has moved visibly."""
    return a.shape == b.shape and bool(np.all(np.abs(a - b) < STILL))
