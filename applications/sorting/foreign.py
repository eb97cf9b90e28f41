"""Find foreign bodies, such as a hand: points that are neither the robot, nor a known solid, nor a known object.

The surface that was seen with the arm at home, widened, is the known world: whatever rises clearly above it, is not
the robot and is not near the tool that holds an object, is foreign. It is reported once two images in a row show it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.places import AROUND, Place, reach_of
from applications.sorting.seeing import Area, heights_of, points_at
from applications.sorting.surface import Surface
from applications.sorting.topics import MAX_OBJECTS, Foreign
from common.config import Surroundings
from common.messages import Header, PlanningScene, Vector3
from common.perception.depth import Depth
from common.perception.pinhole import Pinhole
from common.planning.point_obstacles import KnownShapeFilter

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

CELL = 0.01  # [m] of the grid of the known world
SHIFT = 0.025  # [m] by which objects may have moved since they were seen
THICK = 0.10  # [m] that a body may reach below what is seen of it from above
STRIDE = 2  # [px] between the rows and columns of an image that are used
ROBOT = 0.03  # [m] from the robot, points belong to it


@dataclass(frozen=True)
class ForeignOptions:
    """What counts as foreign.

    Attributes:
        rises: height above the known world [m].
        ceiling: height above the table up to which unknown objects at home are objects and no bodies [m].
        area: least area of a body seen from above [m^2].
        near_tool: points this close to the tool center point of a robot that holds or grips belong to the object [m].
        top: height above the table from which on nothing is looked for [m].
    """

    rises: float = 0.04
    ceiling: float = 0.20
    area: float = 0.0012
    near_tool: float = 0.11
    top: float = 0.7


@dataclass(frozen=True, eq=False)
class RobotAt:
    """Joint positions (dof,) [rad] and gripper width [m] at the time of an image, and whether it may hold something."""

    q: Array
    width: float | None
    T_world_tcp: Array
    gripping: bool = False


class KnownWorld:
    """Heights of all that is known, on a coarse grid of the area in which bodies are looked for."""

    def __init__(self, world: Surroundings, containers: Sequence[Place], area: Area) -> None:
        """Start with table, containers and fixtures; objects are added by `update`."""
        self.area, self.table = area, world.table_height
        self._shape = (max(1, round((area[3] - area[1]) / CELL)), max(1, round((area[2] - area[0]) / CELL)))
        self._fixed = np.full(self._shape, world.table_height, np.float32)
        for place in containers:
            self._raise(place.area(AROUND), place.rim)
        for fixture in world.fixtures:
            x, y, z = reach_of(fixture)
            at = fixture.position
            self._raise((at[0] - x, at[1] - y, at[0] + x, at[1] + y), at[2] + z)
        self.top = self._fixed

    def _raise(self, area: Area, z: float) -> None:
        x, y = (np.clip(np.round((np.array(area)[[k, k + 2]] - self.area[k]) / CELL).astype(int), 0, n)
                for k, n in ((0, self._shape[1]), (1, self._shape[0])))
        part = self._fixed[y[0]:y[1], x[0]:x[1]]
        np.maximum(part, np.float32(z), out=part)

    def update(self, surface: Surface, ceiling: float) -> None:
        """Take the objects of a surface seen with the arm at home, up to a height z [m]."""
        top = np.where(surface.top < ceiling, surface.top, np.float32(-np.inf))  # NaN is not
        highest = cv2.dilate(top, np.ones((3, 3), np.uint8))[1::3, 1::3]  # of 3 x 3 cells
        rows, columns = np.nonzero(np.isfinite(highest))
        xy = surface.xy(3 * rows + 1, 3 * columns + 1)
        x, y = ((xy[:, k] - self.area[k]) / CELL for k in (0, 1))
        inside = (x >= 0) & (x < self._shape[1]) & (y >= 0) & (y < self._shape[0])
        seen = self._fixed.copy()
        np.maximum.at(seen, (y[inside].astype(int), x[inside].astype(int)), highest[rows, columns][inside])
        size = 2 * math.ceil(SHIFT / CELL) + 1
        self.top = np.asarray(cv2.dilate(seen, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))), np.float32)

    def above(self, points: Array) -> Values:
        """Return (n,) the height of points (n, 3) [m] above the known world; -inf outside of the area."""
        x, y = ((points[:, k] - self.area[k]) / CELL for k in (0, 1))
        inside = (x >= 0) & (x < self._shape[1]) & (y >= 0) & (y < self._shape[0])
        result = np.full(len(points), -np.inf, np.float32)
        result[inside] = points[inside, 2] - self.top[y[inside].astype(int), x[inside].astype(int)]
        return result


def strange_points(
    depth: Depth, camera: Pinhole, known: KnownWorld, robot: RobotAt, shapes: KnownShapeFilter, options: ForeignOptions
) -> Array:
    """Return points (n, 3) [m] in world of a depth image that may be foreign bodies."""
    sampled = np.ascontiguousarray(depth[::STRIDE, ::STRIDE])
    coarse = _coarse(camera)
    z = heights_of(sampled, coarse)
    with np.errstate(invalid="ignore"):
        candidate = (z > known.top.min() + options.rises) & (z < known.table + options.top)
    points = points_at(np.flatnonzero(candidate), sampled, coarse)
    points = points[known.above(points) > options.rises]
    if not len(points):
        return points
    near = robot.T_world_tcp[:3, 3]
    reach = options.near_tool if robot.gripping else options.near_tool / 2
    points = points[np.linalg.norm(points - near, axis=1) > reach]
    own = shapes.mask(NOTHING, robot.q, points, margin=ROBOT, object_margin=0.0, width=robot.width)
    return np.asarray(points[~own])


NOTHING = PlanningScene(header=Header())  # no object but the robot
_COARSE: dict[int, tuple[Pinhole, Pinhole]] = {}


def _coarse(camera: Pinhole) -> Pinhole:
    """Return the camera of the sampled rows and columns; the same object for the same camera."""
    found = _COARSE.get(id(camera))
    if found is None or found[0] is not camera:
        n = STRIDE
        coarse = Pinhole(camera.fx / n, camera.fy / n, camera.cx / n, camera.cy / n, -(-camera.width // n),
                         -(-camera.height // n), camera.T_world_optical)
        if len(_COARSE) > 8:
            _COARSE.clear()
        _COARSE[id(camera)] = found = camera, coarse
    return found[1]


def bodies(points: Array, known: KnownWorld, options: ForeignOptions) -> list[Foreign]:
    """Return boxes around points (n, 3) [m] that are connected when seen from above, the largest first."""
    if not len(points):
        return []
    rows, columns = known.top.shape
    x = np.clip(((points[:, 0] - known.area[0]) / CELL).astype(int), 0, columns - 1)
    y = np.clip(((points[:, 1] - known.area[1]) / CELL).astype(int), 0, rows - 1)
    counts = np.bincount(y * columns + x, minlength=rows * columns).reshape(rows, columns)
    _, labels, stats, _ = cv2.connectedComponentsWithStats((counts >= 2).astype(np.uint8), connectivity=8)
    owner = labels[y, x]
    found = []
    for part in np.argsort(-stats[:, cv2.CC_STAT_AREA])[: MAX_OBJECTS + 1].tolist():
        if part == 0 or stats[part, cv2.CC_STAT_AREA] * CELL**2 < options.area:
            continue
        own = points[owner == part]
        low, high = np.percentile(own, 1, axis=0), np.percentile(own, 99, axis=0)
        low[2] = min(low[2], max(high[2] - THICK, float(known.top[y[owner == part], x[owner == part]].max())))
        center, size = (low + high) / 2, high - low
        found.append(Foreign(center=Vector3(x=float(center[0]), y=float(center[1]), z=float(center[2])),
                             size=Vector3(x=float(size[0]), y=float(size[1]), z=float(size[2]))))
    return found[:MAX_OBJECTS]


class Debounce:
    """Reports a body once it was in two images in a row near the same place, and no longer once it is in none."""

    def __init__(self, near: float = 0.15) -> None:
        """Bodies of two images whose boxes are closer than `near` [m] are the same one."""
        self._near, self._before = near, list[Foreign]()

    def confirmed(self, found: Sequence[Foreign]) -> list[Foreign]:
        """Return those bodies of the newest image that the image before it showed too."""
        result = [each for each in found if any(_apart(each, old) < self._near for old in self._before)]
        self._before = list(found)
        return result


def _apart(a: Foreign, b: Foreign) -> float:
    """Distance of two boxes along the axis on which they are farthest apart [m]."""
    return max(abs(p - q) - (s + t) / 2 for p, q, s, t in zip(
        _xyz(a.center), _xyz(b.center), _xyz(a.size), _xyz(b.size), strict=True))


def _xyz(v: Vector3) -> tuple[float, float, float]:
    return v.x, v.y, v.z
