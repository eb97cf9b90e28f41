"""The robot's collision geometry, loaded once: convex hulls, pairs that can collide, how far joints move points."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.kernel.world import Shape
from common.robot.model import RobotModel

Array = NDArray[np.float64]


class RobotGeometry:
    """Convex hulls of the links of a robot.

    Attributes:
        geometry: pinocchio geometry model with the pairs that can collide: all but those the SRDF disables.
        links: link name of each hull; joints: index of the joint in `robot.model` that carries it, 0 for the base.
    """

    def __init__(self, robot: RobotModel) -> None:
        """Load the collision meshes of a robot as hulls.

        Raises:
            ConfigError: a mesh is not there, or the SRDF does not parse.
        """
        self.robot = robot
        full = convex_hulls(robot.full_geometry(pin.GeometryType.COLLISION))
        _, geometry = pin.buildReducedModel(robot.full_model, full, robot.locked_ids, robot.full_reference)
        geometry.addAllCollisionPairs()
        if robot.srdf is not None:
            pin.removeCollisionPairs(robot.model, geometry, str(robot.srdf), False)
        self.geometry = geometry
        self.links: list[str] = [robot.model.frames[item.parentFrame].name for item in geometry.geometryObjects]
        self.joints: list[int] = [item.parentJoint for item in geometry.geometryObjects]
        self._axes = _joint_axes(robot.model)
        self.levers = [self.lever(item) for item in geometry.geometryObjects]

    @cached_property
    def kernel_shapes(self) -> list[Shape]:
        """The hulls as the compiled kernel wants them.

        Raises:
            NoKernel: one is a shape that it does not know.
        """
        return [Shape.of(item.geometry) for item in self.geometry.geometryObjects]

    def lever(self, item: pin.GeometryObject) -> Array:
        """(dof,) [m]: while joint j turns by one radian no point of the shape moves farther than lever[j].

        A point lies no farther from a joint's axis than the path to it along the chain of joints between. Zero for
        joints that do not move the shape.
        """
        model = self.robot.model
        lever = np.zeros(model.nq)
        joint = item.parentJoint
        if joint == 0:
            return lever
        corners = shape_corners(item.geometry, item.placement)
        lever[joint - 1] = _farthest_from_axis(corners, self._axes[joint])
        beyond = float(np.linalg.norm(corners, axis=1).max())  # from the origin of `joint`
        while model.parents[joint] != 0:
            offset = np.array(model.jointPlacements[joint].translation)[None, :]
            joint = model.parents[joint]
            lever[joint - 1] = _farthest_from_axis(offset, self._axes[joint]) + beyond
            beyond += float(np.linalg.norm(offset))
        return lever


def convex_hulls(geometry: pin.GeometryModel) -> pin.GeometryModel:
    """The same model with a convex hull in place of each mesh: hulls check several times faster."""
    for item in geometry.geometryObjects:
        if isinstance(item.geometry, coal.BVHModelBase):
            item.geometry.buildConvexHull(True, "Qt")
            item.geometry = item.geometry.convex
    return geometry


def _joint_axes(model: pin.Model) -> list[Array | None]:
    """Unit axis of each revolute joint in its own frame; None for joints that do not turn about one axis."""
    data = model.createData()
    jacobian = np.array(pin.computeJointJacobians(model, data, pin.neutral(model)))
    axes: list[Array | None] = [None]
    for joint in range(1, model.njoints):
        axis = np.array(data.oMi[joint].rotation).T @ jacobian[3:, model.joints[joint].idx_v]
        axes.append(axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 0.5 else None)
    return axes


def _farthest_from_axis(points: Array, axis: Array | None) -> float:
    """Largest distance [m] of points (N, 3) from an axis through the origin; a prismatic joint moves all by one."""
    if axis is None:
        return 1.0
    return float(np.linalg.norm(points - np.outer(points @ axis, axis), axis=1).max())


def shape_corners(shape: coal.CollisionGeometry, placement: pin.SE3) -> Array:
    """(8, 3) corners [m] of the box about a shape, in the frame in which the shape is placed."""
    shape.computeLocalAABB()
    low, high = np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return np.asarray(corners @ np.array(placement.rotation).T + np.array(placement.translation))


def largest(levers: Sequence[Array]) -> Array:
    """(dof,) the largest lever of each joint."""
    return np.asarray(np.max(np.array(levers), axis=0))
