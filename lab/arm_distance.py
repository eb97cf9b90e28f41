"""Distance between two arms by pinocchio and coal: a judge that uses nothing of the coordinator's proof."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.robot_geometry import convex_hulls
from common.robot.model import RobotModel

Array = NDArray[np.float64]

FAR = 0.1  # [m] distances beyond it are not measured


class ArmDistance:
    """Two arms with the convex hulls of all their collision meshes."""

    def __init__(self, one: RobotModel, other: RobotModel) -> None:
        """Load the hulls.

        Raises:
            ConfigError: a mesh is missing.
        """
        self._arms = [(robot.model, robot.model.createData(), robot.reduced(convex_hulls(robot.full_geometry()))[1])
                      for robot in (one, other)]
        self._placed = [pin.GeometryData(geometry) for _, _, geometry in self._arms]
        self._bounds = [[_bound(item) for item in geometry.geometryObjects] for _, _, geometry in self._arms]
        self._request = coal.DistanceRequest()

    def least(self, q_one: Array, q_other: Array) -> float:
        """Return the distance between the arms [m], inf beyond `FAR`; 0 or less: contact."""
        for (model, data, geometry), placed, q in zip(self._arms, self._placed, (q_one, q_other), strict=True):
            pin.updateGeometryPlacements(model, data, geometry, placed, q)
        (ones, one_radii), (others, other_radii) = (
            (np.array([T.act(center) for T, (center, _) in zip(placed.oMg, bounds, strict=True)]),
             np.array([radius for _, radius in bounds]))
            for placed, bounds in zip(self._placed, self._bounds, strict=True))
        gaps = np.linalg.norm(ones[:, None] - others, axis=2) - one_radii[:, None] - other_radii
        least = np.inf
        for i, a in enumerate(self._arms[0][2].geometryObjects):
            for j, b in enumerate(self._arms[1][2].geometryObjects):
                if (a.parentJoint == 0 and b.parentJoint == 0) or gaps[i, j] > min(least, FAR):
                    continue
                A, B = self._placed[0].oMg[i], self._placed[1].oMg[j]
                least = min(least, coal.distance(
                    a.geometry, coal.Transform3s(A.rotation, A.translation),
                    b.geometry, coal.Transform3s(B.rotation, B.translation),
                    self._request, coal.DistanceResult()))
        return float(least)


def _bound(item: pin.GeometryObject) -> tuple[Array, float]:
    """Return center and radius [m] of a sphere around a shape."""
    item.geometry.computeLocalAABB()
    return np.array(item.geometry.aabb_center), float(item.geometry.aabb_radius)
