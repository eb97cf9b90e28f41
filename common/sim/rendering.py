"""What cameras see of the simulated world: fixtures, containers, objects, and the arm before them.

There are two kinds of picture. In a full one all of that is solid, with colour and depth, and rays are cast at it. In a
plain one the table is grey with a grid, a container is drawn by its edges, and the arm, with what it holds, is out of
sight unless a robot is given; spheres in it are exact and cost a few tenths of a millisecond for all of them.
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
from common.perception.pinhole import Pinhole
from common.perception.sphere import silhouette
from common.robot.transforms import pose_to_matrix
from common.scene.fixtures import container_panels
from common.sim.lighting import white_level
from common.sim.objects import appearance_of, solid_of_message
from common.sim.ray_caster import Mesh, View, cast, empty_view
from common.sim.solids import fixture_mesh, placed, primitive
from common.sim.table import tables

if TYPE_CHECKING:  # most pictures have no arm in them
    from common.robot.model import RobotModel

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

GROUND = (178 / 255, 178 / 255, 178 / 255)  # of a full picture
ARM = (0.55, 0.55, 0.55)
FEW = 32  # spheres that are drawn at once
STILL = 1e-4  # joints that moved by less [rad] leave the picture as it is
STILL_POSE = 1e-6  # [m, and of a rotation] a camera that moved by less sees the same
BASE = 128  # of a plain picture: all three channels
GRID = 108
GRID_SPACING = 40  # [px]
RIM = (255, 255, 255)
RIM_WIDTH = 2  # [px]
_SHIFT = 4  # fractional bits of coordinates handed to OpenCV: 1/16 px


class Renderer:
    """One camera's view. Rays are cast only for what changed: at what stands still once, at the arm when it moved."""

    def __init__(
        self, around: Surroundings, robot: RobotModel | None = None, *, plain: bool = False,
        camera: Pinhole | None = None, rim_width: float = RIM_WIDTH, scenery: Scenery | None = None,
    ) -> None:
        """Draw what never changes.

        Args:
            around: fixtures and containers, and the camera if none is given.
            robot: whose links are seen; without one there is no arm.
            plain: draw a plain picture.
            camera: intrinsics and the pose of the optical frame.
            rim_width: of the white line on the outline of each sphere in a plain picture [px]; 0 for none.
            scenery: the light. It is even: only how bright and of which colour it is counts.

        Raises:
            ConfigError: a mesh of the robot is not there.
        """
        self.camera = camera if camera is not None else Pinhole.from_config(around.camera)
        self.needs_arm = robot is not None
        self.set_light(scenery or Scenery())
        self._plain, self._rim_width, self._robot, self._around = plain, rim_width, robot, around
        self._shapes = _shapes_of(robot) if robot is not None else {}
        self._meshes: dict[tuple[object, ...], Array] = {}  # triangles of what was seen, in its own frame
        self._solid = [] if plain else _solid(around)
        self._asked: Sequence[WorldObject] | None = None
        self._objects: list[WorldObject] | None = None
        self._joints: Array | None = None
        self._spheres: dict[tuple[float, ...], _Sphere | None] = {}  # of the last plain picture, by centre and radius
        self._draw_behind()

    def set_light(self, scenery: Scenery) -> None:
        """Take the light of the scenery: nothing looks different, but for who exposes a picture to it."""
        self.level = white_level(scenery)

    def move_camera(self, camera: Pinhole) -> None:
        """Take the camera elsewhere: from there all is seen anew."""
        if camera.T_world_optical is self.camera.T_world_optical or np.allclose(
                camera.T_world_optical, self.camera.T_world_optical, rtol=0, atol=STILL_POSE):
            return
        self.camera, self._asked, self._objects, self._joints, self._spheres = camera, None, None, None, {}
        self._draw_behind()

    def _draw_behind(self) -> None:
        self._behind = self._plain_background(self._around) if self._plain else empty_view(self.camera, GROUND)
        self._deep = bool(np.isfinite(self._behind.depth).any())  # something in the background may hide a sphere
        self._still = self._seen = self._behind

    def takes_long(self, objects: Sequence[WorldObject]) -> bool:
        """Whether to `render` the objects may take longer than a moment: rays are cast at all but a few spheres."""
        slow = len(objects) > FEW or any(thing.shape != "sphere" for thing in objects)
        return bool(self._shapes) or (slow and objects != self._asked)

    def render(self, objects: Sequence[WorldObject], joints: JointState | None = None) -> View:
        """The view of the objects and of the arm in that state; without a complete state, of the objects alone.

        The depth of a plain picture knows neither table nor spheres. What is "elsewhere" is out of sight.
        """
        self._asked = objects
        hidden = ("held", "elsewhere") if self._plain and not self._shapes else ("elsewhere",)
        seen = [thing for thing in objects if thing.state not in hidden]
        changed = self._objects is None or seen != self._objects
        if changed:
            self._objects = seen
            self._still = self._with_objects(seen, [])
        positions = None if joints is None else np.array(joints.position)
        if changed or not _same(positions, self._joints):
            self._joints = positions
            arm = self._arm(joints)
            if arm and self._plain:  # spheres are drawn after all else
                self._seen = self._with_objects(seen, arm)
            else:
                self._seen = cast(arm, self.camera, self._still) if arm else self._still
        return self._seen

    def _plain_background(self, around: Surroundings) -> View:
        """Table, fixtures and containers of a plain picture."""
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
        spheres = [thing for thing in objects if self._plain and thing.shape == "sphere"]
        things = [thing for thing in objects if not (self._plain and thing.shape == "sphere")]
        known, self._meshes = self._meshes, {}  # of what is seen now: whoever is on the network can tell of any number
        solid = [*self._solid, *(self._mesh(thing, known) for thing in things), *arm]
        plain = View(self._behind.colour.copy(), self._behind.depth)
        view = cast(solid, self.camera, self._behind) if solid else plain
        distances = [float(np.linalg.norm(_centre(thing) - self.camera.position)) for thing in spheres]
        hidden, before, self._spheres = self._deep or bool(solid), self._spheres, {}
        for index in sorted(range(len(spheres)), key=lambda i: -distances[i]):  # what is nearer hides what is farther
            thing = spheres[index]
            key = *_centre(thing).tolist(), thing.size.x / 2
            shape = before[key] if key in before else _seen_sphere(
                self.camera, _centre(thing), thing.size.x / 2, self._rim_width)
            self._spheres[key] = shape
            if shape is not None:
                _blend_sphere(view, shape, _bgr(thing), hidden=hidden)
        return view

    def _mesh(self, thing: WorldObject, known: Mapping[tuple[object, ...], Array]) -> Mesh:
        look = appearance_of(thing)
        if look not in self._meshes:
            self._meshes[look] = known[look] if look in known else solid_of_message(thing).triangles
        color = (thing.color.r, thing.color.g, thing.color.b)
        return Mesh(placed(self._meshes[look], pose_to_matrix(thing.pose)), color)

    def _arm(self, joints: JointState | None) -> list[Mesh]:
        if joints is None or self._robot is None or not self._shapes:
            return []
        poses = link_poses(self._robot, joints)
        if poses is None:
            return []
        return [Mesh(placed(corners, poses[link]), ARM) for link, corners in self._shapes.items()]


def _shapes_of(robot: RobotModel) -> dict[str, Array]:
    from common.sim.solids import robot_shapes

    return robot_shapes(robot)


def link_poses(robot: RobotModel, joints: JointState) -> Mapping[str, Array] | None:
    """(4, 4) pose of each link in world, fingers too; None where the state lacks a joint of the arm."""
    q = robot.order(joints.name, joints.position)
    if q is None:
        return None
    others = {name: value for name, value in zip(joints.name, joints.position, strict=True)
              if name in robot.config.locked_joints}
    return robot.link_poses(q, others)


def _solid(around: Surroundings) -> list[Mesh]:
    """Fixtures and the panels of containers."""
    panels = [panel for box in around.containers.values() for panel in container_panels(box, around.table_height)]
    return [
        *(fixture_mesh(fixture) for fixture in around.fixtures),
        *(Mesh(placed(primitive("box", panel.dimensions), pose_to_matrix(panel.pose)),
               (panel.color.r, panel.color.g, panel.color.b)) for panel in panels),
    ]


def draw(
    objects: Sequence[WorldObject], camera: Pinhole, around: Surroundings, *, noise_std: float = 0.0,
    brightness: float = 0.0, rng: np.random.Generator | None = None, rim_width: float = RIM_WIDTH,
) -> Picture:
    """One plain picture, bgr8 (height, width, 3), of the objects; see `Renderer` and `add_image_noise`."""
    picture = Renderer(around, plain=True, camera=camera, rim_width=rim_width).render(objects).colour
    return add_image_noise(picture, noise_std, brightness, rng)


def add_image_noise(
    picture: Picture, noise_std: float, brightness: float, rng: np.random.Generator | None = None
) -> Picture:
    """The picture with Gaussian noise of that standard deviation, and brightness added to each channel."""
    if noise_std <= 0 and brightness == 0:
        return picture
    values = picture.astype(np.float32)
    if noise_std > 0:
        generator = rng if rng is not None else np.random.default_rng(0)
        values += generator.standard_normal(picture.shape, dtype=np.float32) * np.float32(noise_std)
    values += np.float32(brightness)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def add_depth_noise(depth: Depth, rng: np.random.Generator, noise_std: float, dropout: float) -> Depth:
    """The depth image with Gaussian noise [m], and with NaN in a part of its pixels."""
    measured = depth
    if noise_std > 0:
        measured = measured + np.float32(noise_std) * rng.standard_normal(depth.shape, dtype=np.float32)
    if dropout > 0:
        measured = np.where(rng.random(depth.shape, dtype=np.float32) < dropout, np.float32(np.nan), measured)
    return measured


@dataclass(frozen=True)
class _Sphere:
    """How a sphere is seen within columns and rows `low` to `high` of a picture; arrays are (rows, columns, 1)."""

    low: npt.NDArray[np.int_]
    high: npt.NDArray[np.int_]
    rim: Array  # how much of each pixel its outline covers
    inner: Array  # and what lies inside of that
    near: Array  # depth [m]


def _seen_sphere(camera: Pinhole, center: Array, radius: float, rim_width: float) -> _Sphere | None:
    """How much of each pixel a sphere covers; None where nothing of it is seen.

    The rim straddles the outline. OpenCV's filled polygons are half a pixel too large all the way round, which is as
    much as the whole error of a good fit; the distance of a pixel from the outline is exact.
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
    away = np.maximum(x * x + y * y + z * z - along, 0.0)  # squared distance of rays from the centre [m^2]
    beyond = np.sqrt(away) - radius  # distance of rays from the sphere [m]
    slope = np.hypot(*np.gradient(beyond))  # [m/px]
    outside = beyond / np.maximum(slope, 1e-9)  # [px]
    near = (np.sqrt(along) - np.sqrt(np.maximum(radius**2 - away, 0.0))) / np.sqrt(1 + a * a + b * b)
    rim = np.clip(0.5 + rim_width / 2 - outside, 0, 1) if rim_width else np.zeros_like(outside)
    inner = np.clip(0.5 - rim_width / 2 - outside, 0, 1)
    return _Sphere(low, high, rim[..., None], inner[..., None], near[..., None])


def _blend_sphere(view: View, sphere: _Sphere, color: tuple[int, int, int], *, hidden: bool) -> None:
    """Blend one sphere into the picture; with `hidden`, what is nearer in the view's depth stays before it."""
    (left, top), (right, bottom) = sphere.low, sphere.high
    shows: float | npt.NDArray[np.float32] = 1.0
    if hidden:
        shows = (sphere.near < view.depth[top:bottom, left:right, None]).astype(np.float32)
    cut = view.colour[top:bottom, left:right]
    blended = cut.astype(np.float32)
    for part, paint in ((sphere.rim, RIM), (sphere.inner, color)):
        blended += shows * part * (np.array(paint, np.float32) - blended)
    cut[...] = np.rint(blended).astype(np.uint8)


def _draw_container(picture: Picture, camera: Pinhole, container: Container, table_height: float) -> None:
    """The outer edges of the container: the rim, the base and the four corners between them."""
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
    cv2.polylines(picture, edges, False, (b, g, r), 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, rings[:1], True, (b, g, r), 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, rings[1:], True, (b, g, r), 2, cv2.LINE_AA, _SHIFT)


def _fixed_point(pixels: Array) -> npt.NDArray[np.int32]:
    """Coordinates with fractional bits; far outside the picture they are cut, which nobody can see."""
    return np.rint(np.clip(pixels, -4000, 20000) * (1 << _SHIFT)).astype(np.int32)


def _centre(thing: WorldObject) -> Array:
    p = thing.pose.position
    return np.array([p.x, p.y, p.z])


def _bgr(thing: WorldObject) -> tuple[int, int, int]:
    r, g, b = (round(255 * value) for value in (thing.color.r, thing.color.g, thing.color.b))
    return b, g, r


def _same(a: Array | None, b: Array | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(np.all(np.abs(a - b) < STILL))
