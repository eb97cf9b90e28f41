"""Scenes for grasps without an arm: objects that fell into the tray of a cell, and what the cell's camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from applications.sorting.clusters import find_objects
from applications.sorting.grasps.gripper_shape import GripperShape
from applications.sorting.learning.floating import Bench, Conditions, PhysicalObject
from applications.sorting.objects.stacking import silhouette, stacked
from applications.sorting.seeing import Area, surface_of
from applications.sorting.surface import Surface
from applications.sorting.topics import SeenObject
from common.config import Cell, Container, Surroundings, load_cell
from common.config.basics import check
from common.errors import ConfigError
from common.perception.pinhole import Pinhole
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.robot.transforms import quaternion_to_matrix, transform
from common.sim.rendering import add_depth_noise
from common.sim.sensors import DepthSensorParameters, simulate_depth

Array = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.uint8]

DEPTH_CAMERA = "depth_camera"  # service whose noise is used
HIGHEST = 0.20  # [m] above the table; the image is cropped to the tray up to this height
BORDER = 0.03  # [m] around the tray that is seen too
FRICTIONS = (0.2, 0.6)  # of the pads
OFFSET, TURN = 0.003, 3.0  # [m], [deg] error of the tool's pose: calibration of hand and eye
SHADE = 0.03  # standard deviation of an image's brightness


@dataclass(frozen=True, eq=False)
class Rig:
    """What a cell contributes to a scene.

    Attributes:
        around: containers and table.
        tray: that the objects lie in.
        camera: cropped to the tray.
        noise: of its depth; `dropout` is the fraction of pixels without depth.
        shape: of the gripper.
        area: that the surface covers, in world [m].
    """

    around: Surroundings
    tray: Container
    camera: Pinhole
    noise: DepthSensorParameters
    dropout: float
    shape: GripperShape
    area: Area

    @classmethod
    def of(cls, cell: Cell, tray: str = "tray") -> Rig:
        """Take tray, camera, noise and gripper from a cell.

        Raises:
            ConfigError: the cell has no such tray, or no gripper with fingers.
        """
        around = cell.section(Surroundings)
        assert isinstance(around, Surroundings)
        container = around.containers.get(tray)
        if container is None:
            raise ConfigError("tray", tray, f"is no container; choices: {', '.join(around.containers) or 'none'}")
        half = container.half_side + BORDER
        area = (container.x - half, container.y - half, container.x + half, container.y + half)
        service = cell.services.get(DEPTH_CAMERA)
        given = dict(service.parameters) if service is not None else {}
        used = {k: v for k, v in given.items() if k in DepthSensorParameters.model_fields}
        camera = _cropped(Pinhole.from_config(around.camera), area, around.table_height)
        shape = GripperShape.of(RobotGeometry(RobotModel.load(cell.robot)))
        dropout = float(given.get("depth_dropout", 0.0))
        return cls(around, container, camera, check(DepthSensorParameters, used), dropout, shape, area)


def rig_of(cell: str, overrides: Sequence[str] = ()) -> Rig:
    """Return the rig of a cell by its name or file."""
    return Rig.of(load_cell(cell, tuple(overrides)))


def _cropped(camera: Pinhole, area: Area, table: float) -> Pinhole:
    """Return the part of a camera that sees an area between the table and `HIGHEST`."""
    corners = np.array([(x, y, table + z) for x in area[::2] for y in area[1::2] for z in (0.0, HIGHEST)])
    pixels = camera.project(corners)
    low = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + 1, (camera.width, camera.height)).astype(int)
    width, height = (high - low).tolist()
    return Pinhole(camera.fx, camera.fy, camera.cx - float(low[0]), camera.cy - float(low[1]), width, height,
                   camera.T_world_optical)


@dataclass(frozen=True, eq=False)
class Seen:
    """What perception finds in one image: the surface, the index + 1 of the object of each cell, and the objects."""

    surface: Surface
    labels: npt.NDArray[np.int32]
    objects: list[SeenObject]


def fallen(rig: Rig, objects: Sequence[PhysicalObject], rng: np.random.Generator, tries: int = 3) -> Bench | None:
    """Let objects fall into the tray; None if they do not come to rest there in several tries.

    A single object falls anywhere, several onto a heap.
    """
    for _ in range(tries):
        rotations = [_random_rotation(rng) for _ in objects]
        outlines = [silhouette(np.concatenate(list(thing.parts)) @ R.T)
                    for thing, R in zip(objects, rotations, strict=True)]
        places = stacked(outlines, rig.tray, rig.around.table_height, rng, heap=len(objects) > 1)
        poses = [transform(R, place) for R, place in zip(rotations, places, strict=True)]
        bench = Bench(objects, poses, rig.tray, rig.shape, rig.around.table_height)
        if bench.settle(2.0 + 0.2 * len(objects)):
            return bench
    return None


def _random_rotation(rng: np.random.Generator) -> Array:
    x, y, z, w = (values := rng.normal(size=4)) / np.linalg.norm(values)
    return quaternion_to_matrix(float(x), float(y), float(z), float(w))


def look(rig: Rig, bench: Bench, rng: np.random.Generator) -> tuple[Depth, Pixels]:
    """Return the measured depth (height, width) [m] and the image (height, width, 3) of the rig's camera."""
    camera = rig.camera
    rays = _optical_rays(camera)
    distance, geoms = bench.cast(camera.position, rays @ camera.T_world_optical[:3, :3].T)
    true = distance.reshape(camera.height, camera.width).astype(np.float32)
    depth = add_depth_noise(simulate_depth(true, camera, rig.noise, rng), rng, 0.0, rig.dropout)
    colors = np.concatenate([bench.model.geom_rgba[:, :3], np.zeros((1, 3))])[geoms, ::-1]
    bright = 255 * colors.reshape(camera.height, camera.width, 3)
    noise = rng.normal(1.0, SHADE, (camera.height, camera.width, 1))
    return depth, np.clip(bright * noise, 0, 255).astype(np.uint8)


def _optical_rays(camera: Pinhole) -> Array:
    """(n, 3) directions of all pixels in the optical frame, 1 long along its z."""
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fy
    x, y = np.meshgrid(u, v)
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def perceive(rig: Rig, bench: Bench, rng: np.random.Generator) -> Seen:
    """Look at the tray and find the objects in it."""
    depth, image = look(rig, bench, rng)
    floor = rig.around.table_height + rig.tray.floor_thickness
    surface = surface_of([(depth, image, rig.camera)], rig.area, floor=floor)
    labels, objects = find_objects(surface, rig.around)
    return Seen(surface, labels, objects)


def draw_conditions(
    rng: np.random.Generator, force: float, *, error: float = 1.0, frictions: tuple[float, float] = FRICTIONS
) -> Conditions:
    """Draw the friction, and the directions of the error of the pose.

    Args:
        rng: source.
        force: of each finger [N].
        error: of the pose, as a multiple of `OFFSET` and `TURN`.
        frictions: smallest and largest.
    """
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angle = np.radians(TURN) * error / 2
    x, y, z = (np.sin(angle) * directions[1]).tolist()
    T = transform(quaternion_to_matrix(x, y, z, float(np.cos(angle))), np.asarray(OFFSET * error * directions[0]))
    return Conditions(float(rng.uniform(*frictions)), force, T)
