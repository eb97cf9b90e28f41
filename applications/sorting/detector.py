"""From the images of depth cameras to the message about the heap: objects, grasps and foreign bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.clusters import Identities, Labels, find_objects
from applications.sorting.foreign import NOTHING, Debounce, ForeignOptions, KnownWorld, RobotAt, bodies, strange_points
from applications.sorting.places import containers_of, hidden_fraction, tray_of
from applications.sorting.registration import Registration
from applications.sorting.seeing import Area, View, denoised, heights_of, points_at, surface_of
from applications.sorting.surface import Surface
from applications.sorting.topics import MAX_OBJECTS, Foreign, Heap, SeenObject
from common.config import RobotConfig, Surroundings
from common.messages import Header, Vector3
from common.planning.camera_obstacles import JointHistory
from common.planning.point_obstacles import KnownShapeFilter
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel

Array = npt.NDArray[np.float64]

WORLD = "world"
AROUND = 0.08  # [m] of the table around the containers in which objects are looked for
LOW = 0.10  # [m] above the table: lower points are compared with the robot only where they may be foreign
LARGEST = 0.20  # [m] what is longer is no object of a tray but a foreign body
ROBOT = 0.03  # [m] from the robot, points belong to it
NEAR_TRAY = 0.08  # [m] from the tray to the tool: what that holds hides nothing of the tray either
FEWEST = 30  # [px] of the arm in front of the tray


@dataclass(frozen=True, eq=False)
class Seen:
    """What one image shows.

    Attributes:
        heap: the message, without grasps.
        surface: the image from above; None away from home.
        labels: (rows, columns) k + 1 at the cells of the k-th object.
    """

    heap: Heap
    surface: Surface | None = None
    labels: Labels = field(default_factory=lambda: np.zeros((0, 0), np.int32))


class HeapDetector:
    """Sees objects while the arm is at home, and foreign bodies always. Not thread-safe."""

    def __init__(
        self, world: Surroundings, robot: RobotConfig, *, tray: str = "tray", field_name: str = "tray",
        area: Area | None = None, options: ForeignOptions | None = None,
    ) -> None:
        """Load the robot.

        Args:
            world: containers, of which one is the tray, and fixtures.
            robot: whose points are no objects.
            tray: id of the container with the objects.
            field_name: of the parameter that names it, for errors.
            area: in which objects are looked for [m]; None: the containers and the table around them.
            options: what is foreign.

        Raises:
            ConfigError: the world has no such container, or a file of the robot is missing.
        """
        self.world, self.tray = world, tray_of(world, tray, field_name)
        self.options = options or ForeignOptions()
        self.robot = RobotModel.load(robot)
        self.geometry = RobotGeometry(self.robot)
        self.joints = JointHistory(self.robot)
        containers = containers_of(world)
        self.area = area or area_around([place.area(AROUND) for place in containers])
        self._shapes = KnownShapeFilter(self.geometry)
        self._known = KnownWorld(world, containers, self.area)
        self.registration = Registration(self.tray)
        self._identities, self._debounce = Identities(), Debounce()
        self._before: Labels | None = None  # labels of the newest image of the tray
        self._at_home: Surface | None = None  # of the newest image from home

    def look(self, views: Sequence[View], stamp: int, *, at_home: bool, gripping: bool) -> Seen | None:
        """Return what images of one instant show; None while the position of the arm at that time is unknown.

        Args:
            views: of the cameras, the main one first.
            stamp: of the images [ns].
            at_home: whether the arm was at home; elsewhere the tray counts as seen if no view of it is obstructed.
            gripping: whether the gripper holds an object, or moves.
        """
        q = self.joints.at(stamp)
        if q is None:
            return None
        robot = RobotAt(q, self.joints.width(stamp), self.robot.fk(q), gripping)
        smooth: list[View] = [(denoised(depth), image, camera) for depth, image, camera in views]
        if at_home:
            self.registration.update(smooth)
        smooth = self.registration.apply(smooth)
        header = Header(stamp=stamp, frame_id=WORLD)
        if not at_home and (self._at_home is None or not self._tray_is_clear(smooth[0], robot)):
            return Seen(Heap(header=header, foreign=self._foreign(smooth, robot)))
        surface = self._surface(smooth, robot)
        if at_home or self._at_home is None:
            self._at_home = surface
        else:
            surface = self._with_tray_of(surface, self._at_home)
        labels, objects = find_objects(surface, self.world, self._before)
        labels, objects, large = without_bodies(labels, objects)
        self._known.update(without(surface, labels == -1), self.world.table_height + self.options.ceiling)
        foreign = [*self._foreign(smooth, robot), *large][:MAX_OBJECTS]
        self._before = np.maximum(labels, 0)
        heap = Heap(header=header, at_home=True, objects=self._identities.named(objects, self._before), foreign=foreign,
                    hidden=hidden_fraction(surface, self.tray))
        return Seen(heap, surface, self._before)

    def _tray_is_clear(self, view: View, robot: RobotAt) -> bool:
        """Return whether nothing is between the camera and the tray, such as the arm or the object that it holds."""
        depth, _, camera = view
        x, y, _ = robot.T_world_tcp[:3, 3]
        if max(abs(x - self.tray.x), abs(y - self.tray.y)) < self.tray.outer + NEAR_TRAY:
            return False
        x0, y0, x1, y1 = self.tray.area()
        corners = np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (self.tray.floor, self.tray.rim)])
        pixels = camera.project(corners)
        if not np.isfinite(pixels).all():
            return False
        inside = np.zeros(depth.shape, np.uint8)
        cv2.fillConvexPoly(inside, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
        z = heights_of(depth, camera).reshape(depth.shape)[inside > 0]
        with np.errstate(invalid="ignore"):
            return int((z > self.world.table_height + self.options.ceiling).sum()) < FEWEST

    def _with_tray_of(self, now: Surface, before: Surface) -> Surface:
        """Return a surface seen from home, with the tray as it is seen now: the arm hides the rest."""
        x0, y0, x1, y1 = self.tray.area()
        first, last = before.cells([(x0, y0), (x1, y1)])
        rows, columns = slice(max(first[0], 0), last[0] + 1), slice(max(first[1], 0), last[1] + 1)
        top, color = before.top.copy(), before.color.copy()
        top[rows, columns], color[rows, columns] = now.top[rows, columns], now.color[rows, columns]
        return Surface(before.origin, before.step, top, color, before.floor)

    def _foreign(self, views: Sequence[View], robot: RobotAt) -> list[Foreign]:
        points = [strange_points(depth, camera, self._known, robot, self._shapes, self.options)
                  for depth, _, camera in views]
        return self._debounce.confirmed(bodies(np.concatenate(points), self._known, self.options))

    def _surface(self, views: Sequence[View], robot: RobotAt) -> Surface:
        """Return the surface without the robot and without what is above the ceiling."""
        cleared: list[View] = []
        for depth, image, camera in views:
            z = heights_of(depth, camera)
            with np.errstate(invalid="ignore"):
                drop = z > self.world.table_height + self.options.ceiling
                high = np.flatnonzero((z > self.world.table_height + LOW) & ~drop)
            if len(high):
                points = points_at(high, depth, camera)
                own = self._shapes.mask(NOTHING, robot.q, points, margin=ROBOT, object_margin=0.0,
                                        width=robot.width)
                drop[high[own]] = True
            cleared.append((np.where(drop.reshape(depth.shape), np.float32(np.nan), depth), image, camera))
        return surface_of(cleared, self.area, floor=self.tray.floor, smooth=True)


def area_around(areas: Sequence[Area]) -> Area:
    """Return the smallest area that contains all areas [m]."""
    low, high = np.min(np.array(areas)[:, :2], axis=0), np.max(np.array(areas)[:, 2:], axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def without(surface: Surface, cells: npt.NDArray[np.bool_]) -> Surface:
    """Return a surface without a measurement in some cells (rows, columns)."""
    if not cells.any():
        return surface
    top = np.where(cells, np.float32(np.nan), surface.top)
    return Surface(surface.origin, surface.step, top, surface.color, surface.floor)


def without_bodies(labels: Labels, objects: list[SeenObject]) -> tuple[Labels, list[SeenObject], list[Foreign]]:
    """Separate what is too large for an object: labels with -1 there, the objects, and the bodies."""
    large = np.array([max(seen.size.x, seen.size.z) > LARGEST for seen in objects], bool)
    if not large.any():
        return labels, objects, []
    numbers = np.zeros(len(objects) + 1, np.int32)
    numbers[1:][large] = -1
    numbers[1:][~large] = np.arange(1, int((~large).sum()) + 1)
    found = [_body(seen) for seen, out in zip(objects, large, strict=True) if out]
    return numbers[labels], [seen for seen, out in zip(objects, large, strict=True) if not out], found


def _body(seen: SeenObject) -> Foreign:
    corners = np.array(seen.outline)
    low, high = corners.min(axis=0), corners.max(axis=0)
    x, y = ((low + high) / 2).tolist()
    return Foreign(center=Vector3(x=x, y=y, z=(seen.top + seen.bottom) / 2),
                   size=Vector3(x=float(high[0] - low[0]), y=float(high[1] - low[1]), z=seen.top - seen.bottom))

