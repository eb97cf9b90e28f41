"""How exactly an outline was traced: the way of the tool tip, compared with the contour and with the truth.

The truth is read for this evaluation only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.applications.outlining.messages import OutlinePoints, OutlineStatus
from common.config import RobotConfig
from common.messages import JointState, WorldObjects

Array = NDArray[np.float64]

BEFORE = ("IDLE", "SELECTING", "PLANNING")
UNDER_WAY = ("APPROACHING", "TRACING", "RETREATING")
CLOSED = 1e-3  # [m] first and last place of a closed outline are no farther apart, but for what lies between two looks
MOST_STATES = 100_000  # joint states of one tracing that are kept: a quarter of an hour at 100 Hz


class Traced:
    """Follows one cell that outlines objects; tells of the newest outline."""

    def __init__(self, robot: RobotConfig) -> None:
        """Start with nothing seen.

        Args:
            robot: whose tool tip traces.
        """
        self._robot = robot
        self._status = OutlineStatus()
        self._path: OutlinePoints | None = None
        self._truth: WorldObjects | None = None  # when the arm began to approach
        self._newest_truth: WorldObjects | None = None
        self._states: list[JointState] = []
        self._began: int | None = None  # stamps [ns] of the statuses between which the outline was traced
        self._ended: int | None = None

    def on_status(self, status: OutlineStatus) -> None:
        """Take note of how far the task is."""
        before, self._status = self._status.state, status
        if status.state == before:
            return
        if status.state == "APPROACHING":
            self._states, self._began, self._ended = [], None, None
            self._truth = self._newest_truth  # a person may move what was traced
        elif status.state == "TRACING":
            self._began = status.header.stamp
        elif before == "TRACING":
            self._ended = status.header.stamp

    def on_path(self, path: OutlinePoints) -> None:
        """Take note of the contour; once the arm moves it may hide a part of it."""
        if path.poses and self._status.state in BEFORE:
            self._path = path

    def on_truth(self, truth: WorldObjects) -> None:
        """Take note of where everything really is."""
        self._newest_truth = truth

    def on_joints(self, state: JointState) -> None:
        """Take note of where the joints are. Statuses and joint states overtake each other: their stamps decide."""
        if self._status.state in UNDER_WAY and len(self._states) < MOST_STATES:
            self._states.append(state)

    def figures(self) -> dict[str, Any]:
        """The block "outline" of a summary; without deviations where nothing was traced or no truth is known."""
        tips = self._tips()
        tips[:, 2] -= self._status.standoff
        path, outlines = self._path_points(), self._outlines()
        near = [distances(tips, points) for points in outlines] if len(tips) else []
        return {
            "object": self._status.object,
            "points": self._status.points,
            "fraction": round(self._fraction(tips), 4),
            "length_m": round(self._status.length_m, 4),
            "closed": self._status.closed and _is_closed(tips),
            "deviation_mm": _millimetres(min(near, key=lambda d: float(d.mean()), default=None)),
            "tracking_mm": _millimetres(distances(tips, path) if len(tips) and len(path) > 1 else None),
        }

    def _fraction(self, tips: Array) -> float:
        """How much of the contour was traced; what the status tells is how much of it was planned."""
        if self._status.closed or not self._status.length_m:
            return self._status.fraction
        way = float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum()) if len(tips) > 1 else 0.0
        return min(self._status.fraction, way / self._status.length_m)

    def _tips(self) -> Array:
        """Places (N, 3) [m] of the tool tip while it traced."""
        began, ended = self._began, self._ended
        if began is None:
            return np.zeros((0, 3))
        from common.robot.model import RobotModel  # takes as long to load as all else: only when it is needed

        robot = RobotModel.load(self._robot)
        tips = []
        for state in self._states:
            q = robot.order(state.name, state.position)
            if q is not None and began <= state.header.stamp and (ended is None or state.header.stamp <= ended):
                tips.append(robot.fk(q)[:3, 3])
        return np.array(tips).reshape(-1, 3)

    def _path_points(self) -> Array:
        poses = self._path.poses if self._path else []
        return np.array([(p.position.x, p.position.y, p.position.z) for p in poses]).reshape(-1, 3)

    def _outlines(self) -> list[Array]:
        """Edges (n, 3) [m] of the true top faces, outer and inner."""
        truth = self._truth or self._newest_truth
        objects = truth.objects if truth else []
        edges: list[tuple[Sequence[tuple[float, float]], float]] = []
        for thing in objects:
            edges += [(edge, thing.base + thing.height) for edge in (thing.outline, thing.hole) if len(edge) > 2]
        return [np.column_stack([np.array(edge), np.full(len(edge), top)]) for edge, top in edges]


def _is_closed(tips: Array) -> bool:
    """Whether the first and the last place (N, 3) are the same, as well as joint states that come now and then show."""
    if len(tips) < 2:
        return False
    steps = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    return float(np.linalg.norm(tips[0] - tips[-1])) <= CLOSED + float(steps.max())


def distances(places: Array, corners: Array) -> Array:
    """Distance (N,) [m] of places (N, 3) from the closed polyline through corners (M, 3)."""
    edges = np.roll(corners, -1, axis=0) - corners
    squares = np.maximum((edges**2).sum(axis=1), 1e-18)
    nearest = np.empty(len(places))
    for i, place in enumerate(places):
        offset = place - corners
        share = np.clip((offset * edges).sum(axis=1) / squares, 0.0, 1.0)
        nearest[i] = np.sqrt(((offset - share[:, None] * edges) ** 2).sum(axis=1).min())
    return nearest


def _millimetres(values: Array | None) -> dict[str, float] | None:
    if values is None:
        return None
    return {"mean": round(1e3 * float(values.mean()), 4), "max": round(1e3 * float(values.max()), 4)}
