"""The robot's collision geometry, loaded once: convex hulls, pairs that can collide, levers of the joints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.errors import ConfigError
from common.planning.kernel.world import Shape
from common.robot.finger_joints import finger_positions
from common.robot.model import RobotModel

Array = NDArray[np.float64]

_CACHED_WIDTHS = 32  # of the gripper


class RobotGeometry:
    """Convex hulls of the links of a robot.

    Attributes:
        geometry: pinocchio geometry model with the pairs that can collide: all but those that the SRDF disables, or the
            robot file allows.
        links: link name of each hull; joints: index of the joint in `robot.model` that carries it, 0 for the base.
    """

    def __init__(self, robot: RobotModel) -> None:
        """Load the collision meshes of a robot as hulls.

        Raises:
            ConfigError: a mesh is missing, or the SRDF does not parse.
        """
        self.robot = robot
        full = convex_hulls(robot.full_geometry())
        geometry = robot.reduced(full)[1]
        geometry.addAllCollisionPairs()
        if robot.srdf is not None:
            try:
                pin.removeCollisionPairs(robot.model, geometry, str(robot.srdf), False)
            except (ValueError, RuntimeError) as error:
                reason = " ".join(str(error).split())
                raise ConfigError("robot.srdf", str(robot.srdf), f"does not parse: {reason}") from None
        self.geometry = geometry
        self._full_data = robot.full_model.createData()
        self.links: list[str] = [robot.model.frames[item.parentFrame].name for item in geometry.geometryObjects]
        allowed = [set(pair) for pair in robot.config.allowed_pairs]
        for pair in list(geometry.collisionPairs) if allowed else []:
            if {self.links[pair.first], self.links[pair.second]} in allowed:
                geometry.removeCollisionPair(pair)
        self.joints: list[int] = [item.parentJoint for item in geometry.geometryObjects]
        self._fingers = self._moved_by_fingers(full)
        self._openings: dict[float | None, list[tuple[int, pin.SE3, Array]]] = {}
        self._axes = _joint_axes(robot.model)
        self.levers = [self.lever(item) for item in geometry.geometryObjects]

    @cached_property
    def kernel_shapes(self) -> list[Shape]:
        """The hulls as shapes of the compiled kernel.

        Raises:
            KernelUnavailable: the kernel does not support one of them.
        """
        return [Shape.of(item.geometry) for item in self.geometry.geometryObjects]

    def _moved_by_fingers(self, full: pin.GeometryModel) -> list[tuple[int, int, int, pin.SE3]]:
        """Return hulls that the gripper's joints move.

        Each as its index, the joints of the full model that carry it with the gripper locked and not, and its placement
        in the latter.
        """
        robot, gripper = self.robot, self.robot.config.gripper
        joints = {robot.full_model.getJointId(name) for name in (gripper.joints if gripper else [])}
        found = []
        for index, (item, joint) in enumerate(zip(full.geometryObjects, self.joints, strict=True)):
            if joints & set(robot.full_model.supports[item.parentJoint]):
                carrier = robot.full_model.getJointId(robot.model.names[joint]) if joint else 0
                found.append((index, carrier, item.parentJoint, item.placement.copy()))
        return found

    def finger_placements(self, width: float | None) -> list[tuple[int, pin.SE3]]:
        """Return the index of each hull that the gripper moves, and its placement in its joint, at a width [m].

        None: the width at which the robot file locks the gripper.
        """
        if width is None:
            return [(index, self.geometry.geometryObjects[index].placement) for index, *_ in self._fingers]
        gripper, full = self.robot.config.gripper, self.robot.full_model
        if gripper is None or not self._fingers:
            return []
        q = self.robot.full_reference.copy()
        for name, position in zip(gripper.joints, finger_positions(gripper, width), strict=True):
            q[full.joints[full.getJointId(name)].idx_q] = position
        pin.forwardKinematics(full, self._full_data, q)
        placed = self._full_data.oMi
        return [
            (index, placed[carrier].actInv(placed[joint]) * placement)
            for index, carrier, joint, placement in self._fingers
        ]

    def opening(self, width: float | None) -> list[tuple[int, pin.SE3, Array]]:
        """Return `finger_placements`, each with its lever; the newest widths are cached."""
        found = self._openings.get(width)
        if found is None:
            found = []
            for index, placement in self.finger_placements(width):
                item = self.geometry.geometryObjects[index]
                moved = pin.GeometryObject(item.name, item.parentJoint, item.parentFrame, placement, item.geometry)
                found.append((index, placement, self.lever(moved)))
            if len(self._openings) >= _CACHED_WIDTHS:
                self._openings.pop(next(iter(self._openings)))
            self._openings[width] = found
        return found

    def lever(self, item: pin.GeometryObject) -> Array:
        """Return (dof,) [m]: while joint j turns by one radian, no point of the shape moves farther than lever[j].

        A point is no farther from a joint's axis than the length of the chain of joints to it. Zero for joints that do
        not move the shape.
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
    """Replace each mesh of the model by its convex hull, which checks several times faster, and return the model."""
    for item in geometry.geometryObjects:
        if isinstance(item.geometry, coal.BVHModelBase):
            item.geometry.buildConvexHull(True, "Qt")
            item.geometry = item.geometry.convex
    return geometry


def _joint_axes(model: pin.Model) -> list[Array | None]:
    """Return the unit axis of each revolute joint in its own frame; None for joints that do not turn about one axis."""
    data = model.createData()
    jacobian = np.array(pin.computeJointJacobians(model, data, pin.neutral(model)))
    axes: list[Array | None] = [None]
    for joint in range(1, model.njoints):
        axis = np.array(data.oMi[joint].rotation).T @ jacobian[3:, model.joints[joint].idx_v]
        axes.append(axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 0.5 else None)
    return axes


def _farthest_from_axis(points: Array, axis: Array | None) -> float:
    """Return the largest distance [m] of points (N, 3) from an axis through the origin; 1 for a prismatic joint."""
    if axis is None:
        return 1.0
    return float(np.linalg.norm(points - np.outer(points @ axis, axis), axis=1).max())


def shape_corners(shape: coal.CollisionGeometry, placement: pin.SE3) -> Array:
    """Return (8, 3) corners [m] of the bounding box of a shape, in the frame in which the shape is placed."""
    shape.computeLocalAABB()
    low, high = np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return np.asarray(corners @ np.array(placement.rotation).T + np.array(placement.translation))


def largest(levers: Sequence[Array]) -> Array:
    """Return (dof,) the largest lever of each joint."""
    return np.asarray(np.max(np.array(levers), axis=0))
