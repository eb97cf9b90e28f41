"""The robot's collision geometry, loaded once: convex hulls, pairs that may touch removed, how far joints move points."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.errors import ConfigError
from common.robot.model import RobotModel

Array = NDArray[np.float64]


class RobotGeometry:
    """Convex hulls of the links of a robot.

    Attributes:
        geometry: pinocchio geometry model with the pairs that can collide: all but those the SRDF disables.
        links: link name of each geometry.
        lever: (dof,) [m]: one radian of joint j moves no point of the robot by more than lever[j].
    """

    def __init__(self, robot: RobotModel) -> None:
        """Load the collision meshes of a robot as hulls.

        Raises:
            ConfigError: a mesh is not there, or the SRDF does not parse.
        """
        self.robot = robot
        folders = [str(folder) for folder in robot.package_folders]
        try:
            full = pin.buildGeomFromUrdf(
                robot.full_model, str(robot.urdf), pin.GeometryType.COLLISION, package_dirs=folders
            )
        except ValueError as error:
            raise ConfigError("robot.urdf", str(robot.urdf), f"has a mesh that can not be loaded: {error}") from None
        _, geometry = pin.buildReducedModel(robot.full_model, full, robot.locked_ids, robot.full_reference)
        for item in geometry.geometryObjects:
            if isinstance(item.geometry, coal.BVHModelBase):
                item.geometry.buildConvexHull(True, "Qt")  # hulls check several times faster than meshes
                item.geometry = item.geometry.convex
        geometry.addAllCollisionPairs()
        if robot.srdf is not None:
            pin.removeCollisionPairs(robot.model, geometry, str(robot.srdf), False)
        self.geometry = geometry
        self.links: list[str] = [robot.model.frames[item.parentFrame].name for item in geometry.geometryObjects]
        self.joints: list[int] = [item.parentJoint for item in geometry.geometryObjects]
        self._reach = _own_reach(geometry, robot.dof)
        self._offsets = [np.array(robot.model.jointPlacements[j + 1].translation) for j in range(robot.dof)]
        self.lever = self.lever_with({})

    def lever_with(self, attached_reach: dict[int, float]) -> Array:
        """`lever` with objects attached: joint index -> distance [m] of their farthest point from its origin.

        Walks from the tool to the base: a point lies no farther from a joint's origin than the path along the chain.
        """
        model = self.robot.model
        reach = self._reach.copy()
        for joint, distance in attached_reach.items():
            if joint > 0:
                reach[joint - 1] = max(reach[joint - 1], distance)
        for j in range(model.nq - 1, 0, -1):
            parent = model.parents[j + 1] - 1
            if parent >= 0:
                reach[parent] = max(reach[parent], reach[j] + float(np.linalg.norm(self._offsets[j])))
        return reach


def _own_reach(geometry: pin.GeometryModel, dof: int) -> Array:
    """(dof,) distance [m] from each joint's origin to the farthest point of the hulls that it carries."""
    reach = np.zeros(dof)
    for item in geometry.geometryObjects:
        if item.parentJoint > 0:
            reach[item.parentJoint - 1] = max(reach[item.parentJoint - 1], shape_reach(item.geometry, item.placement))
    return reach


def shape_reach(shape: coal.CollisionGeometry, placement: pin.SE3) -> float:
    """Distance [m] from the frame's origin to the farthest corner of the box about a shape placed in that frame."""
    shape.computeLocalAABB()
    low, high = np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    placed = corners @ np.array(placement.rotation).T + np.array(placement.translation)
    return float(np.linalg.norm(placed, axis=1).max())
