"""The shape of a parallel gripper as boxes that depend on its width, taken from the robot's collision geometry.

All boxes are in the closing frame: at the tool center point, z along the tool away from the arm, y along which the
fingers close.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.errors import ConfigError
from common.planning.kernel.world import Shape
from common.planning.robot_geometry import RobotGeometry, shape_corners
from common.robot.finger_joints import closing_frame
from common.robot.transforms import invert

Array = NDArray[np.float64]
Coordinates = NDArray[np.float32]

WIDTHS = 9  # at which the boxes are measured; between them they are interpolated
HEIGHT = 0.10  # [m] parts that start farther behind the tips are left to the planning kernel
UNDERSIDES = 0.005, 0.012  # [m] between sample points of fingers and of the palm, on faces towards the tips
SURFACES = 0.009, 0.020  # [m] the same where sides count, too
_ROUNDING = 1e-6  # [m]
TIP_BAND = 0.012  # [m] of the length of the fingers that counts as their tips


@dataclass(frozen=True, eq=False)
class Samples:
    """Points on boxes whose corners depend on the width of the gripper.

    Attributes:
        max_width: of the gripper [m].
        table: (3, k, m) float32, x, y and z of the points at k widths, evenly from closed to open [m].
    """

    max_width: float
    table: Coordinates

    def placed(self, T: Array, width: Array) -> Coordinates:
        """Return (3, n, m) points [m] at widths (n,) [m] of grippers whose closing frames are at T (n, 4, 4)."""
        below, part = _between(width, self.max_width, self.table.shape[1])
        before = self.table[:, below]
        local = before + part.astype(np.float32)[:, None] * (self.table[:, below + 1] - before)
        frame = T.astype(np.float32)[:, :3, :, None]  # (n, 3, 4, 1)
        found = np.empty_like(local)
        for k in range(3):
            found[k] = frame[:, k, 3]
            for j in range(3):
                found[k] += frame[:, k, j] * local[j]
        return found


@dataclass(frozen=True, eq=False)
class GripperShape:
    """Boxes about the parts of a gripper in its closing frame, by its width.

    Attributes:
        T_tcp_closing: (4, 4) pose of the closing frame in the TCP frame.
        max_width: between the fully open fingers [m].
        widths: (k,) at which the boxes are known, rising [m].
        table: (k, b, 2, 3) low and high corners [m].
        finger: (b,) which boxes belong to fingers; the others are the palm.
    """

    T_tcp_closing: Array
    max_width: float
    widths: Array
    table: Array
    finger: NDArray[np.bool_]

    @classmethod
    def of(cls, geometry: RobotGeometry) -> GripperShape:
        """Measure the collision geometry of a robot's gripper.

        Raises:
            ConfigError: the robot has no gripper with fingers.
        """
        robot = geometry.robot
        gripper = robot.config.gripper
        if gripper is None or not gripper.joints:
            raise ConfigError("robot.gripper", robot.config.name, "has no fingers; grasps need a parallel gripper")
        frame = robot.model.frames[robot.tcp_frame]
        T_closing_joint = pin.SE3(invert(frame.placement.homogeneous @ closing_frame(gripper)))
        items = geometry.geometry.geometryObjects
        fixed = {i: item.placement for i, item in enumerate(items) if item.parentJoint == frame.parentJoint}
        widths = np.linspace(0.0, gripper.max_width, WIDTHS)
        rows = []
        for width in widths:
            placed = fixed | dict(geometry.finger_placements(float(width)))
            rows.append([_bounds(items[i].geometry, T_closing_joint * placed[i]) for i in fixed])
        table = np.array(rows)
        moved = {i for i, _ in geometry.finger_placements(None)}
        finger = np.array([i in moved for i in fixed])
        near = table[:, :, 1, 2].max(axis=0) > table[:, finger, 1, 2].max() - HEIGHT
        return cls(closing_frame(gripper), gripper.max_width, widths, table[:, near], finger[near])

    def tip(self, width: ArrayLike) -> Array:
        """Return (...) how far the finger tips reach beyond the TCP at widths (...) [m]; negative: not so far."""
        return np.asarray(np.interp(np.asarray(width, float), self.widths, self._tips))

    @cached_property
    def _tips(self) -> Array:
        return np.asarray(self.table[:, self.finger, 1, 2].max(axis=1))

    @cached_property
    def _at_tips(self) -> Array:
        """Boxes (n, 2, 3) of the open fingers that reach to their tips."""
        boxes = self.table[-1, self.finger]
        return np.asarray(boxes[boxes[:, 1, 2] > boxes[:, 1, 2].max() - TIP_BAND])

    @property
    def pad_half_width(self) -> float:
        """Half the width of the finger tips, across the closing axis [m]."""
        return float(self._at_tips[:, 1, 0].max())

    @property
    def finger_thickness(self) -> float:
        """Extent of a finger tip along the closing axis [m]."""
        boxes = self._at_tips[self._at_tips[:, 0, 1] > 0]
        return float(boxes[:, 1, 1].max() - boxes[:, 0, 1].min())

    @property
    def finger_length(self) -> float:
        """Distance from the palm to the tips of the open fingers [m]."""
        palm = self.table[-1, ~self.finger, 1, 2].max() if not self.finger.all() else -np.inf
        return float(self._tips[-1] - palm)

    @cached_property
    def finger_undersides(self) -> Samples:
        """Points of the fingers on faces towards the tips: all that matters while the tool points straight down."""
        return self._samples(self.finger, sides=False)

    @cached_property
    def palm_undersides(self) -> Samples:
        """The same of the palm."""
        return self._samples(~self.finger, sides=False)

    @cached_property
    def finger_surfaces(self) -> Samples:
        """Points of the fingers on faces towards the tips and on the sides."""
        return self._samples(self.finger, sides=True)

    @cached_property
    def surfaces(self) -> Samples:
        """The same of fingers and palm."""
        return self._samples(np.ones_like(self.finger), sides=True)

    def _samples(self, boxes: NDArray[np.bool_], sides: bool) -> Samples:
        index, fractions = [], []
        for number in np.flatnonzero(boxes).tolist():
            low, high = self.table[-1, number]
            step = (SURFACES if sides else UNDERSIDES)[0 if self.finger[number] else 1]
            x, y, z = (np.linspace(0, 1, max(2, int(np.ceil((b - a) / step)) + 1)) for a, b in zip(
                low, high, strict=True))
            grid = np.stack(np.meshgrid(x, y, z if sides else z[-1:], indexing="ij"), axis=-1).reshape(-1, 3)
            outer = (grid[:, 2] == 1) | ((grid[:, :2] == 0) | (grid[:, :2] == 1)).any(axis=1)
            outer &= ~self._covered(low + grid * (high - low), number, sides)
            fractions.append(grid[outer])
            index += [number] * int(outer.sum())
        if not index:
            return Samples(self.max_width, np.zeros((3, len(self.widths), 0), np.float32))
        low, high = self.table[:, index, 0], self.table[:, index, 1]
        points = low + np.concatenate(fractions) * (high - low)  # (k, m, 3)
        return Samples(self.max_width, np.ascontiguousarray(points.transpose(2, 0, 1), dtype=np.float32))

    def _covered(self, points: Array, number: int, sides: bool) -> NDArray[np.bool_]:
        """Return (m,) which points (m, 3) of a box are inside another one, or above one if sides do not count."""
        covered = np.zeros(len(points), bool)
        for other in np.flatnonzero(self.finger == self.finger[number]).tolist():
            low, high = self.table[-1, other]
            if other == number or high[2] < self.table[-1, number, 1, 2]:
                continue
            low = low.copy()
            low[2] = low[2] if sides else -np.inf
            strictly = (points > low + _ROUNDING) & (points < high - _ROUNDING)
            covered |= strictly.all(axis=1)
        return covered


def _between(width: ArrayLike, max_width: float, count: int) -> tuple[NDArray[np.int64], Array]:
    """Return the index of the known width below a width [m], and the part of the way to the next one."""
    at = np.clip(np.asarray(width, float) / max_width, 0.0, 1.0) * (count - 1)
    below = np.minimum(at.astype(np.int64), count - 2)
    return below, np.asarray(at - below)


def _bounds(shape: object, placement: pin.SE3) -> Array:
    """Return (2, 3) bounds [m] of a shape at a placement, in the frame of the placement."""
    points = Shape.of(shape).points  # of a hull
    corners = points @ placement.rotation.T + placement.translation if len(points) else shape_corners(shape, placement)
    return np.array([corners.min(axis=0), corners.max(axis=0)])
