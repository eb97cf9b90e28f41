"""What a robot hides of a camera's picture: where its links stand before whatever lies behind them.

Each link is seen as the convex hull of its collision shape, so nothing that is hidden is taken for seen. Where the
joints were at the time of the picture is known only to within some readings: what a link sweeps between them counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin

from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import invert

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

COARSE = 4  # [px] of the picture that make one of the mask
MARGIN = 4.0  # [px] by which a shape may be seen further out than it is: calibration, the mask's own pixels
NEAREST = 0.01  # [m] before the optical centre: what is nearer, or behind it, is cut off
READINGS = 4  # joint positions that are kept, one a picture
BY_ROBOT = "the robot"


@dataclass(frozen=True, eq=False)
class Occlusion:
    """What of a picture cannot be judged.

    Attributes:
        camera: that took it.
        by: what hides it, for people.
        away: (rows, columns) how far each part of the picture is from what is hidden [px]; None: nothing can be judged.
    """

    camera: Pinhole
    by: str = BY_ROBOT
    away: npt.NDArray[np.float32] | None = None

    @property
    def everything(self) -> bool:
        """Whether the whole picture tells nothing."""
        return self.away is None

    def hides(self, places: npt.ArrayLike, radius: float = 0.0) -> Bools:
        """(n,) whether what is as large as that about places (n, 3) [m] in world is out of view, or hidden in part."""
        points = np.asarray(places, dtype=float).reshape(-1, 3)
        outside = ~self.camera.in_picture(np.nan_to_num(self.camera.project(points), nan=-1e6))
        return np.asarray(outside | self.touches(points, radius))

    def touches(self, places: npt.ArrayLike, radius: float = 0.0) -> Bools:
        """(n,) whether what hides is seen where something as large as that about places (n, 3) [m] would be."""
        points = np.asarray(places, dtype=float).reshape(-1, 3)
        if self.away is None:
            return np.ones(len(points), bool)
        depth = np.maximum(self.camera.to_camera(points)[:, 2], NEAREST)
        reach = max(self.camera.fx, self.camera.fy) * radius / depth + MARGIN
        rows, columns = self.away.shape
        at = np.nan_to_num(self.camera.project(points), nan=0.0) / COARSE
        u, v = np.clip(at[:, 0], 0, columns - 1).astype(int), np.clip(at[:, 1], 0, rows - 1).astype(int)
        return np.asarray(self.away[v, u] <= reach)


class RobotSilhouettes:
    """The outlines of a robot's links in pictures."""

    def __init__(self, robot: RobotModel, carries: float = 0.0) -> None:
        """Read its shapes.

        Args:
            robot: asked for link poses; nobody else may ask it at the same time.
            carries: radius of what it may hold at its tool centre point [m], which hides as the hand does.

        Raises:
            ConfigError: a mesh is not there.
        """
        self._robot = robot
        self._shapes = _corners(robot)
        if carries > 0:
            tool = robot.config.tcp_link
            held = carries * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
            self._shapes[f"{tool} holds"] = held
        self._links = {name: name.removesuffix(" holds") for name in self._shapes}

    def hidden(self, camera: Pinhole, readings: Sequence[Array], links: Sequence[str] | None = None) -> Occlusion:
        """What the robot hides of a camera's picture, wherever it was among joint positions (dof,) [rad].

        Args:
            camera: that took the picture.
            readings: at least one.
            links: of these alone; all without.
        """
        import cv2  # a task asks for this when it has to look from elsewhere, if ever

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
                middles = (seen + 0.5) / COARSE - 0.5  # that of a pixel is at whole numbers
                hull = cv2.convexHull(np.clip(np.rint(16 * middles), -2**20, 2**20).astype(np.int32))
                cv2.fillConvexPoly(clear, hull, 0, cv2.LINE_8, 4)
                cv2.polylines(clear, [hull], True, 0, 1, cv2.LINE_8, 4)
        if clear.all():  # OpenCV knows no distance then
            away = np.full((rows, columns), camera.width + camera.height)
        else:
            away = cv2.distanceTransform(clear, cv2.DIST_L2, 3) * COARSE
        return Occlusion(camera, away=np.asarray(away, np.float32))


class RobotOcclusion:
    """What a robot hides of picture after picture of one camera; the same as long as both stand still."""

    def __init__(self, silhouettes: RobotSilhouettes) -> None:
        """Begin without knowing where the joints are."""
        self._silhouettes = silhouettes
        self._readings: deque[tuple[int, Array]] = deque(maxlen=READINGS)
        self._last: tuple[Pinhole, list[Array], Occlusion] | None = None

    def in_picture(self, camera: Pinhole, stamp: int, q: Array | None, read: int) -> Occlusion | None:
        """What it hides of a picture that was taken at `stamp` [ns]; None as long as nobody knows where it is.

        Args:
            camera: that took it.
            stamp: when.
            q: the newest joint positions (dof,) [rad].
            read: when those were read [ns].
        """
        if q is not None and (not self._readings or read > self._readings[-1][0]):
            self._readings.append((read, q))
        if not self._readings:
            return None
        before = [k for k, (at, _) in enumerate(self._readings) if at <= stamp]
        some = list(self._readings)[before[-1] if before else 0 :]
        wanted = [some[0][1], *(q for (_, q), (_, p) in zip(some[1:], some, strict=False) if not _same(q, p))]
        last = self._last
        if last is not None and last[0] is camera and len(last[1]) == len(wanted) and all(map(_same, last[1], wanted)):
            return last[2]
        hidden = self._silhouettes.hidden(camera, wanted)
        self._last = camera, wanted, hidden
        return hidden


def _same(a: Array, b: Array) -> bool:
    return bool(np.abs(a - b).max() < 1e-3)


def _project(camera: Pinhole, points: Array) -> Array:
    """Pixels (k, 2) about the convex hull of points (n, 3) [m]; what is behind the camera is cut off."""
    p = camera.to_camera(points)
    before = p[:, 2] > NEAREST
    if not before.any():
        return np.empty((0, 2))
    kept = p[before]
    if not before.all():  # where the edges between both sides of the plane before the camera go through it
        a, b = kept[:: max(1, len(kept) // 32)], p[~before][:: max(1, int((~before).sum()) // 32)]
        t = (a[:, None, 2] - NEAREST) / (a[:, None, 2] - b[None, :, 2])
        cut = a[:, None] + t[..., None] * (b[None] - a[:, None])
        kept = np.concatenate([kept, cut.reshape(-1, 3)])
    return np.column_stack([camera.fx * kept[:, 0] / kept[:, 2] + camera.cx,
                            camera.fy * kept[:, 1] / kept[:, 2] + camera.cy])


def _corners(robot: RobotModel) -> dict[str, Array]:
    """Points (n, 3) [m] whose convex hull holds each part of the robot, by link."""
    parts: dict[str, list[Array]] = {}
    for item in robot.full_geometry(pin.GeometryType.COLLISION).geometryObjects:
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
