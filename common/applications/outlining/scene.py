"""The planning scene of a cell that outlines objects: what is fixed, and every solid that a picture showed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common import messages as m
from common.applications.outlining.perceived_solids import PerceivedSolid
from common.config import Surroundings
from common.scene.fixtures import fixture_objects

AT_HOME = 0.02  # [rad] from it the arm is out of the picture as well


def planning_scene(around: Surroundings, solids: Sequence[PerceivedSolid], stamp: int) -> m.PlanningScene:
    """Fixtures and perceived solids, in world, as seen in the picture with that stamp."""
    header = m.Header(stamp=stamp, frame_id="world")
    return m.PlanningScene(header=header, objects=[*fixture_objects(around), *map(collision_object, solids)])


def collision_object(solid: PerceivedSolid) -> m.CollisionObject:
    """A perceived solid as an upright prism; its id is the label of its contour."""
    x, y = (solid.outline.min(axis=0) + solid.outline.max(axis=0)) / 2
    return m.CollisionObject(
        id=solid.label, role="target", shape="prism", dimensions=[solid.height], color=solid.color,
        outline=[(float(u), float(v)) for u, v in solid.outline - np.array([x, y])],
        pose=m.Pose(position=m.Vector3(x=float(x), y=float(y), z=solid.base + solid.height / 2)),
    )


class HomeWatch:
    """Knows since when the arm is at home: only then does a picture show the objects without the arm."""

    def __init__(self, home: Sequence[float]) -> None:
        """Start with nothing known of the arm.

        Args:
            home: joint positions [rad] at which the arm hides nothing.
        """
        self._home = np.array(home)
        self._since: int | None = None
        self._until: int | None = None
        self._known = False

    def note(self, q: Sequence[float], stamp: int) -> None:
        """Take in joint positions [rad] and when they were measured [ns]."""
        if np.abs(np.array(q) - self._home).max() > AT_HOME:
            self._until = stamp if self._until is None else self._until
        elif not self._known:
            self._since = 0  # it has not moved before, as far as anybody here knows
        elif self._until is not None:
            self._since, self._until = stamp, None
        self._known = True

    def covers(self, stamp: int) -> bool:
        """Whether the arm was at home at a time [ns]."""
        return self._since is not None and self._since <= stamp and (self._until is None or stamp < self._until)
