"""Measures how the width of two coupled fingers follows from the position of the driven joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.robot.model import RobotModel
from tools.robot_setup.fingers import APART, DROP, Grip, links_moved, measure

Array = NDArray[np.float64]

WIDEST = 1.6  # largest angle of a driven joint that is searched for contact [rad]
CONTACT = 0.003  # fingers that are closer than this touch [m]
FINE, ROWS = 33, 7  # positions that are measured, and rows of the table
STRAIGHT = 0.0002  # deviation of a width that grows evenly [m]
LEAST = 0.005  # opening of a gripper [m]


@dataclass(frozen=True)
class Travel:
    """Rows of width [m] and joint positions [rad or m], from closed to open, and the grip between the two."""

    rows: list[list[float]]
    grip: Grip


@dataclass(frozen=True)
class Couplings:
    """Joints of two fingers, the driven one first, and how they follow it: factor and offset."""

    joints: list[str]
    factors: list[float]
    offsets: list[float]

    def row(self, position: float) -> list[float]:
        """Return the positions of the joints at a position of the driven one."""
        return [factor * position + offset for factor, offset in zip(self.factors, self.offsets, strict=True)]

    def measured(self, robot: RobotModel, palm: str, points: dict[str, Array], at: Array) -> tuple[Grip, Array] | None:
        """Return the grip over a range of the driven joint, and the range from closed to open; None if there is none.

        Of both directions, the one in which the fingers are farther apart at the end.
        """
        links, best = links_moved(robot, self.joints), None
        for way in (at, at[::-1]):
            grip = measure(robot, palm, links, self.joints, [self.row(float(each)) for each in way], points)
            if grip is not None and (best is None or grip.widths[-1] > best[0].widths[-1]):
                best = grip, way
        return best

    def travel(self, robot: RobotModel, palm: str, points: dict[str, Array], at: Array) -> Travel | str:
        """Return the part of a range in which the width grows from contact, without the tips retreating far."""
        whole = self.measured(robot, palm, points, np.linspace(at[0], at[-1], FINE))
        part = _growing(*whole) if whole is not None else None
        found = self.measured(robot, palm, points, part) if part is not None else None
        if found is None or found[0].widths[-1] - found[0].widths[0] < LEAST:
            return f"the fingers of {self.joints[0]} open by less than {1e3 * LEAST:.0f} mm"
        grip, at = found
        if grip.widths[0] > APART:
            return (f"the fingers of {self.joints[0]} do not meet: they are {1e3 * grip.widths[0]:.0f} mm apart "
                    "where they are closest")
        return Travel(self._rows(grip, at), grip)

    def _rows(self, grip: Grip, at: Array) -> list[list[float]]:
        straight = np.ptp(np.array(grip.widths) - np.linspace(grip.widths[0], grip.widths[-1], len(at))) < STRAIGHT
        rows = []
        for index in np.linspace(0, len(at) - 1, 2 if straight else ROWS).astype(int):
            width = grip.widths[index] if index or grip.widths[0] > CONTACT else 0.0
            rows.append([round(float(value), 5) + 0.0 for value in (width, *self.row(float(at[index])))])
        return rows


def _growing(grip: Grip, at: Array) -> Array | None:
    """Return the positions between contact and the widest opening; None if the width does not grow."""
    widths, heights = np.array(grip.widths), np.array(grip.heights)
    start = end = int(np.argmax(widths))
    while start > 0 and widths[start - 1] < widths[start] and widths[start] > 0:
        start -= 1
    while end > start and heights[start] - heights[end] > DROP:
        end -= 1
    if end <= start:
        return None
    low = float(at[start])
    if widths[start] < 0:
        low += (at[start + 1] - low) * widths[start] / (widths[start] - widths[start + 1])
    return np.linspace(low, at[end], FINE)
