"""Obstacles seen by cameras: points without the robot and known objects, as spheres for the planner."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.messages import PlanningScene
from common.perception.depth import Depth, is_valid
from common.perception.pinhole import Pinhole
from common.planning.kernel.library import library
from common.planning.kernel.world import address
from common.planning.obstacles import ObstacleBank, ObstacleCache, Solid
from common.planning.robot_geometry import RobotGeometry
from common.robot.transforms import pose_to_matrix

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FARTHEST = 1e4  # [m] farther points are ignored
_CELLS = 1 << 20  # of the grid on each side of the origin


@dataclass(frozen=True, eq=False)
class PointObstacle:
    """Spheres (N, 4), centre and radius [m], world, about all that one camera saw; `name` appears in errors."""

    name: str
    spheres: Array


@dataclass(frozen=True, eq=False)
class CameraView:
    """What one camera saw at one time.

    Attributes:
        name: of the resulting obstacle.
        points: (N, 3) [m], world; rows that are not finite are ignored.
        q: (dof,) [rad] where the robot was; width: of its gripper [m], None: as in the robot file.
    """

    name: str
    points: Array
    q: Array
    width: float | None = None


def downsampled(points: Array, side: float, skip: Mask | None = None) -> Array:
    """Return spheres (M, 4), centre and radius [m]: one for each cube of a grid that contains any of points (N, 3).

    A sphere is centred at the mean of its points and contains all of them, so no point is lost. Its radius is at least
    half a side, because a point represents a piece of a surface.

    Args:
        side: of the cubes [m].
        skip: (N,) points to leave out.
    """
    array = np.ascontiguousarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3 or not side > 0:
        raise ValueError(f"points have shape {array.shape}, cubes a side of {side} m")
    found = library()
    if found is None:
        return _downsampled_by_numpy(array, side, skip)
    without = None if skip is None else np.ascontiguousarray(skip, dtype=np.uint8)
    out = np.empty((len(array), 4))
    count = found.zk_thin(
        len(array), address(array), None if without is None else address(without), side, address(out)
    )
    if count < 0:
        raise MemoryError
    return out[:count].copy()


def _downsampled_by_numpy(points: Array, side: float, skip: Mask | None) -> Array:
    used = (np.abs(points) < _FARTHEST).all(axis=1)
    if skip is not None:
        used &= ~skip
    points = points[used]
    cells = np.clip(np.floor(points / side), -_CELLS, _CELLS - 1).astype(np.int64) + _CELLS
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    _, owner, members = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(owner, points[:, k], len(members)) for k in range(3)], axis=1)
    centres = sums / members[:, None]
    radii = np.full(len(members), 0.5 * side)
    np.maximum.at(radii, owner, np.linalg.norm(points - centres[owner], axis=1) * (1 + 1e-12) + 1e-12)
    return np.column_stack([centres, radii])


def depth_points(depth: Depth, camera: Pinhole) -> Array:
    """Return (N, 3) points [m], world, of all pixels of a depth image (height, width) with a depth."""
    valid = is_valid(depth)
    height, width = depth.shape
    far = depth.astype(float)
    seen = np.empty((3, int(np.count_nonzero(valid))))
    with np.errstate(invalid="ignore"):  # of pixels without a depth
        seen[0] = (far * ((np.arange(width) - camera.cx) / camera.fx))[valid]
        seen[1] = (far * ((np.arange(height) - camera.cy) / camera.fy)[:, None])[valid]
    seen[2] = far[valid]
    T = camera.T_world_optical
    return np.ascontiguousarray((T[:3, :3] @ seen + T[:3, 3:]).T)


def occluded_spheres(images: Sequence[tuple[Depth, Pinhole]], low: Array, high: Array, side: float) -> Array:
    """Return spheres (N, 4), centre and radius [m], about the cubes of a box in the world that no camera saw through.

    A camera sees through a cube whose centre is nearer than the depth measured there. Cubes behind that depth, at
    pixels without a depth and outside the image are not known to be free.

    Args:
        images: depth (height, width) [m] and the camera that took it, of one or several.
        low, high: (3,) corners of the box; side: of its cubes [m].
    """
    counts = np.maximum(np.ceil((np.asarray(high) - np.asarray(low)) / side - 1e-9), 1).astype(int)
    axes = [float(low[k]) + side * (np.arange(counts[k]) + 0.5) for k in range(3)]
    middles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    for depth, camera in images:
        T = camera.T_world_optical
        x, y, z = ((middles - T[:3, 3]) @ T[:3, :3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
            inside = (z > 0) & (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
            there = np.flatnonzero(inside)
            through = depth[v[there].astype(int), u[there].astype(int)] > z[there]  # NaN is not
        occluded = np.ones(len(middles), dtype=bool)
        occluded[there[through]] = False
        middles = middles[occluded]
    return np.column_stack([middles, np.full(len(middles), 0.5 * math.sqrt(3) * side)])


class KnownShapeFilter:
    """Finds the points that belong to the robot or to objects of the planning scene. Not thread-safe."""

    def __init__(self, robot: RobotGeometry) -> None:
        self._cache = ObstacleCache(robot)  # separate from the planner's, whose banks belong to its worlds

    def mask(
        self, scene: PlanningScene, q: Array, points: Array, *, margin: float, object_margin: float,
        width: float | None = None,
    ) -> Mask:
        """Return (N,) which of points (N, 3), world, are within a margin [m] of the robot at q or of a known object.

        Args:
            scene: objects and attached objects, with `object_margin`.
            q: (dof,) [rad]; margin: of the robot's own links; width: of its gripper [m].
        """
        bank = self._bank(scene)
        bank.open_fingers(width)
        count = len(scene.objects) + len(scene.attached)
        margins = np.array([margin] * bank.robot_count + [object_margin] * count)
        return bank.near_shapes(q, margins, points)

    def _bank(self, scene: PlanningScene) -> ObstacleBank:
        model = self._cache.robot.robot.model
        solids, poses = [Solid.of(o) for o in scene.objects], [pose_to_matrix(o.pose) for o in scene.objects]
        for item in scene.attached:
            frame = self._cache.robot.robot.frame(item.link)
            solids.append(Solid.of(item.object, model.frames[frame].parentJoint, frame))
            poses.append(model.frames[frame].placement.homogeneous @ pose_to_matrix(item.object.pose))
        bank = self._cache.bank(tuple(solids))
        bank.place(poses)
        return bank

    def obstacle(
        self, view: CameraView, scene: PlanningScene, *, side: float = 0.01, margin: float = 0.03,
        object_margin: float = 0.02,
    ) -> PointObstacle:
        """Return the obstacle of a view: its points without known ones, downsampled to cubes of a side [m]."""
        known = self.mask(scene, view.q, view.points, margin=margin, object_margin=object_margin, width=view.width)
        return PointObstacle(view.name, downsampled(view.points, side, known))

    def unknown(
        self, name: str, spheres: Array, scene: PlanningScene, q: Array, *, margin: float, object_margin: float,
        width: float | None = None,
    ) -> PointObstacle:
        """Return the obstacle of occluded space: spheres (N, 4) without those that reach into known objects."""
        reach = float(spheres[:, 3].max(initial=0.0))
        known = self.mask(
            scene, q, spheres[:, :3], margin=margin + reach, object_margin=object_margin + reach, width=width)
        return PointObstacle(name, spheres[~known])
