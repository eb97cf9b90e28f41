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
        self._request = coal.DistanceRequest()

    def least(self, q_one: Array, q_other: Array) -> float:
        """Return the distance between the arms [m], inf beyond `FAR`; 0 or less: contact."""
        for (model, data, geometry), placed, q in zip(self._arms, self._placed, (q_one, q_other), strict=True):
            pin.updateGeometryPlacements(model, data, geometry, placed, q)
        least = np.inf
        for i, a in enumerate(self._arms[0][2].geometryObjects):
            for j, b in enumerate(self._arms[1][2].geometryObjects):
                if a.parentJoint == 0 and b.parentJoint == 0:
                    continue
                A, B = self._placed[0].oMg[i], self._placed[1].oMg[j]
                if np.linalg.norm(A.act(_center(a)) - B.act(_center(b))) - _radius(a) - _radius(b) > min(least, FAR):
                    continue
                least = min(least, coal.distance(
                    a.geometry, coal.Transform3s(A.rotation, A.translation),
                    b.geometry, coal.Transform3s(B.rotation, B.translation),
                    self._request, coal.DistanceResult()))
        return float(least)


def _center(item: pin.GeometryObject) -> Array:
    item.geometry.computeLocalAABB()
    return np.array(item.geometry.aabb_center)


def _radius(item: pin.GeometryObject) -> float:
    return float(item.geometry.aabb_radius)
