"""Regions of a camera image that the robot occludes.

Each link is projected as the convex hull of its collision shape, so occlusion is never underestimated. Joint positions
at the time of the image are known only from readings visible and after it: the swept hull between them counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import coal
import numpy as np
import numpy.typing as npt

from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import invert

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

COARSE = 4  # [px] of the image per mask pixel
MARGIN = 4.0  # [px] inflation for calibration errors and mask resolution
NEAREST = 0.01  # [m] near clipping plane
READINGS = 4  # joint readings clipped, one per image
BY_ROBOT = "the robot"


@dataclass(frozen=True, eq=False)
class Occlusion:
    """Occluded part of an image.

    Attributes:
        camera: of the image.
        by: cause, for messages.
        away: (rows, columns) distance of each mask pixel from the occluded region [px]; None: everything is occluded.
    """

    camera: Pinhole
    by: str = BY_ROBOT
    distance: npt.NDArray[np.float32] | None = None

    @property
    def covers_image(self) -> bool:
        """Whether the complete image is unusable."""
        return self.distance is None

    def joined(self, other: Occlusion | None) -> Occlusion:
        """Return what this or the other one occludes in the same image."""
        if other is None or self.distance is None or other.distance is None:
            return self if other is None or self.distance is None else other
        return replace(self, distance=np.minimum(self.distance, other.distance))

    def occludes(self, positions: npt.ArrayLike, radius: float = 0.0) -> Bools:
        """(n,) whether objects of a radius [m] at positions (n, 3) [m] in world are out of view or partly occluded."""
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        outside = ~self.camera.in_image(np.nan_to_num(self.camera.project(points), nan=-1e6))
        return np.asarray(outside | self.touches(points, radius))

    def touches(self, positions: npt.ArrayLike, radius: float = 0.0) -> Bools:
        """(n,) whether objects of a radius [m] at positions (n, 3) [m] in world would overlap the occluded region."""
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        if self.distance is None:
            return np.ones(len(points), bool)
        depth = np.maximum(self.camera.to_camera(points)[:, 2], NEAREST)
        reach = max(self.camera.fx, self.camera.fy) * radius / depth + MARGIN
        rows, columns = self.distance.shape
        at = np.nan_to_num(self.camera.project(points), nan=0.0) / COARSE
        u, v = np.clip(at[:, 0], 0, columns - 1).astype(int), np.clip(at[:, 1], 0, rows - 1).astype(int)
        return np.asarray(self.distance[v, u] <= reach)


class RobotSilhouettes:
    """Projects the outlines of a robot's links into images."""

    def __init__(self, robot: RobotModel, carries: float = 0.0) -> None:
        """Read the robot's collision shapes.

        Args:
            robot: its kinematics must not be used concurrently.
            carries: radius of an object that it may hold at its tool center point [m], which occludes too.

        Raises:
            ConfigError: a mesh is missing.
        """
        self._robot = robot
        self._shapes = _corners(robot)
        if carries > 0:
            tool = robot.config.tcp_link
            held = carries * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
            self._shapes[f"{tool} holds"] = held
        self._links = {name: name.removesuffix(" holds") for name in self._shapes}

    def occlusion(self, camera: Pinhole, readings: Sequence[Array], links: Sequence[str] | None = None) -> Occlusion:
        """Return the occlusion by the robot anywhere between joint positions.

        Args:
            camera: of the image.
            readings: joint positions (dof,) [rad], at least one.
            links: only these links; None: all.
        """
        import cv2  # needed only once an occlusion is computed

        rows, columns = -(-camera.height // COARSE), -(-camera.width // COARSE)
        clear = np.full((rows, columns), 255, np.uint8)
        poses = [self._robot.link_poses(q) for q in readings]
        for name, corners in self._shapes.items():
            link = self._links[name]
            if links is not None and link not in links:
                continue
            swept = np.concatenate([corners @ T[link][:3, :3].T + T[link][:3, 3] for T in poses])
            seen = _project(camera, swept)
            if len(seen) >= 3:
                centers = (seen + 0.5) / COARSE - 0.5  # pixel centers are at integers
                hull = cv2.convexHull(np.clip(np.rint(16 * centers), -2**20, 2**20).astype(np.int32))
                cv2.fillConvexPoly(clear, hull, 0, cv2.LINE_8, 4)
                cv2.polylines(clear, [hull], True, 0, 1, cv2.LINE_8, 4)
        if clear.all():  # the distance transform needs a zero pixel
            distance = np.full((rows, columns), camera.width + camera.height)
        else:
            distance = cv2.distanceTransform(clear, cv2.DIST_L2, 3) * COARSE
        return Occlusion(camera, distance=np.asarray(distance, np.float32))


class RobotOcclusion:
    """Tracks the occlusion by the robot over the images of one camera; cached while robot and camera are at rest."""

    def __init__(self, silhouettes: RobotSilhouettes) -> None:
        """Start without a joint reading."""
        self._silhouettes = silhouettes
        self._readings: deque[tuple[int, Array]] = deque(maxlen=READINGS)
        self._last: tuple[Pinhole, list[Array], Occlusion] | None = None

    def in_image(self, camera: Pinhole, stamp: int, q: Array | None, read: int) -> Occlusion | None:
        """Return the occlusion in an image taken at `stamp` [ns]; None before the first joint reading.

        Args:
            camera: of the image.
            stamp: of the image [ns].
            q: newest joint positions (dof,) [rad].
            read: stamp of `q` [ns].
        """
        if q is not None and (not self._readings or read > self._readings[-1][0]):
            self._readings.append((read, q))
        if not self._readings:
            return None
        visible = [k for k, (at, _) in enumerate(self._readings) if at <= stamp]
        since = list(self._readings)[visible[-1] if visible else 0 :]
        selected = [since[0][1], *(q for (_, q), (_, p) in zip(since[1:], since, strict=False) if not _same(q, p))]
        last = self._last
        if last is not None and last[0] is camera and len(last[1]) == len(selected) and all(
                map(_same, last[1], selected)):
            return last[2]
        occlusion = self._silhouettes.occlusion(camera, selected)
        self._last = camera, selected, occlusion
        return occlusion


def _same(a: Array, b: Array) -> bool:
    return bool(np.abs(a - b).max() < 1e-3)


def _project(camera: Pinhole, points: Array) -> Array:
    """Pixels (k, 2) whose convex hull contains the projection of points (n, 3) [m], clipped at the near plane."""
    p = camera.to_camera(points)
    visible = p[:, 2] > NEAREST
    if not visible.any():
        return np.empty((0, 2))
    clipped = p[visible]
    if not visible.all():  # add intersections of edges with the near plane
        a, b = clipped[:: max(1, len(clipped) // 32)], p[~visible][:: max(1, int((~visible).sum()) // 32)]
        t = (a[:, None, 2] - NEAREST) / (a[:, None, 2] - b[None, :, 2])
        cut = a[:, None] + t[..., None] * (b[None] - a[:, None])
        clipped = np.concatenate([clipped, cut.reshape(-1, 3)])
    return np.column_stack([camera.fx * clipped[:, 0] / clipped[:, 2] + camera.cx,
                            camera.fy * clipped[:, 1] / clipped[:, 2] + camera.cy])


def _corners(robot: RobotModel) -> dict[str, Array]:
    """Points (n, 3) [m] whose convex hull contains each link's shapes, by link."""
    parts: dict[str, list[Array]] = {}
    for item in robot.full_geometry().geometryObjects:
        frame = robot.full_model.frames[item.parentFrame]
        T = invert(np.array(frame.placement.homogeneous)) @ np.array(item.placement.homogeneous)
        shape = item.geometry
        if isinstance(shape, coal.BVHModelBase):
            points = np.array(shape.vertices(), dtype=float)
        else:
            shape.computeLocalAABB()
            low, high = np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_)
            points = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1])
                               for z in (low[2], high[2])])
        parts.setdefault(frame.name, []).append(points @ T[:3, :3].T + T[:3, 3])
    return {link: np.concatenate(pieces) for link, pieces in parts.items() if link in robot.link_names}
