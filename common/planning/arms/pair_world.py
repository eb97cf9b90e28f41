"""Two arms in one compiled kernel: lower bounds of the distances between their links, and how far each link moves."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.messages import AttachedObject
from common.planning.kernel.world import CONTACT_ALLOWED, KernelWorld, Shape
from common.planning.obstacles import Solid
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel
from common.robot.transforms import pose_to_matrix

Array = NDArray[np.float64]


class ArmGeometry:
    """Links of one arm with open fingers, as the proof sees them; poses are in the world of the cell."""

    def __init__(self, name: str, robot: RobotModel) -> None:
        """Load the hulls of an arm.

        Raises:
            ConfigError: a mesh is missing.
            KernelUnavailable: the kernel does not support a shape.
        """
        self.name, self.robot = name, robot
        self.hulls = RobotGeometry(robot)
        self.gripper: frozenset[str] = frozenset(robot.config.gripper.links if robot.config.gripper else ())
        self.home: Array = robot.named("home")
        width = robot.config.gripper.max_width if robot.config.gripper else None
        self._opened = {index: (placement, lever) for index, placement, lever in self.hulls.opening(width)}

    def body(self, attached: Sequence[AttachedObject] = ()) -> ArmBody:
        """Return the arm with what it carries.

        Raises:
            UnknownName: an object is attached to a link that this arm does not have.
            InvalidShape: an object has no volume.
        """
        model, items, shapes, levers, names = self.robot.model, [], [], [], []
        for index, item in enumerate(self.hulls.geometry.geometryObjects):
            placement, lever = self._opened.get(index, (item.placement, self.hulls.levers[index]))
            items.append((item.parentJoint, placement, item.geometry))
            shapes.append(self.hulls.kernel_shapes[index])
            levers.append(lever)
            names.append(self.hulls.links[index])
        for held in attached:
            frame = model.frames[self.robot.frame(held.link)]
            geometry = Solid.of(held.object).geometry()
            placement = frame.placement * pin.SE3(pose_to_matrix(held.object.pose))
            items.append((frame.parentJoint, placement, geometry))
            shapes.append(Shape.of(geometry))
            levers.append(self.hulls.lever(
                pin.GeometryObject(held.object.id, frame.parentJoint, placement, geometry)))
            names.append(held.object.id)
        return ArmBody(self, items, shapes, np.array(levers), names)


class ArmBody:
    """An arm with what it carries.

    Attributes:
        arm: its geometry.
        levers: (shapes, dof) [m] the farthest that a radian of each joint moves any point of a shape.
        names: (shapes,) of links and carried objects.
    """

    def __init__(
        self, arm: ArmGeometry, items: list[tuple[int, pin.SE3, object]], shapes: list[Shape], levers: Array,
        names: list[str],
    ) -> None:
        self.arm, self.items, self.shapes, self.levers, self.names = arm, items, shapes, levers, names


class PairWorld:
    """The links of one arm against those of another.

    Attributes:
        one_levers, other_levers: (pairs, dof) [m] levers of the first and the second shape of each pair.
    """

    def __init__(self, one: ArmBody, other: ArmBody, may_touch: Collection[str] = ()) -> None:
        """Pair all moving shapes; the gripper of an arm may touch objects `may_touch` that the other one carries.

        Raises:
            KernelUnavailable: the kernel is not built, or does not support a joint.
        """
        self.one, self.other = one, other
        model, geometry, count = _joined(one, other)
        for i, (a_joint, _, _) in enumerate(one.items):
            for j, (b_joint, _, _) in enumerate(other.items):
                if a_joint or b_joint:
                    geometry.addCollisionPair(pin.CollisionPair(i, count + j))
        self._kernel = KernelWorld(model, geometry, [*one.shapes, *other.shapes])
        first = np.array([pair.first for pair in geometry.collisionPairs])
        second = np.array([pair.second for pair in geometry.collisionPairs]) - count
        self.one_levers, self.other_levers = one.levers[first], other.levers[second]
        self._names = [(one.names[i], other.names[j]) for i, j in zip(first, second, strict=True)]
        self._ignored = np.array([self._may_touch(*pair, may_touch) for pair in self._names])

    def _may_touch(self, a: str, b: str, objects: Collection[str]) -> bool:
        grippers = a in self.one.arm.gripper and b in self.other.arm.gripper and bool(objects)
        return grippers or (a in objects and b in self.other.arm.gripper) or (
            b in objects and a in self.one.arm.gripper) or (a == b and a in objects)

    def distances(self, q_one: Array, q_other: Array) -> tuple[Array, Array]:
        """Return (pairs,) [m] upper and lower bounds of all distances; pairs that may touch are far apart."""
        above, below = self._kernel.distances(np.concatenate([q_one, q_other]))
        above[self._ignored] = below[self._ignored] = -CONTACT_ALLOWED
        return above, below

    def names(self, pair: int) -> tuple[str, str]:
        """Return the names of the shapes of a pair."""
        return self._names[pair]


def _joined(one: ArmBody, other: ArmBody) -> tuple[pin.Model, pin.GeometryModel, int]:
    """Return both arms as one model, the joints of `one` first, and how many shapes `one` has."""
    second = other.arm.robot.model.copy()
    for index in range(1, len(second.names)):
        second.names[index] += " (other)"
    for frame in second.frames:
        frame.name += " (other)"
    model = pin.appendModel(one.arm.robot.model, second, 0, pin.SE3.Identity())
    geometry, offset = pin.GeometryModel(), one.arm.robot.model.njoints - 1
    for number, (joint, placement, shape) in enumerate((*one.items, *(
            (joint + offset if joint else 0, placement, shape) for joint, placement, shape in other.items))):
        geometry.addGeometryObject(pin.GeometryObject(str(number), joint, placement, shape))
    return model, geometry, len(one.items)
