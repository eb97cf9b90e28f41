"""Two arms in one compiled kernel: lower bounds of the distances between their links, and how far each link moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.messages import AttachedObject
from common.planning.kernel.world import KernelWorld, Shape
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
        carried: the latter.
    """

    def __init__(
        self, arm: ArmGeometry, items: list[tuple[int, pin.SE3, object]], shapes: list[Shape], levers: Array,
        names: list[str],
    ) -> None:
        self.arm, self.items, self.shapes, self.levers, self.names = arm, items, shapes, levers, names
        self.carried = names[len(arm.hulls.links):]

    def place(self, name: str, q: Array) -> Array:
        """Return the center (3,) [m] of a carried object at q (dof,) [rad]."""
        joint, placement, _ = self.items[len(self.names) - len(self.carried) + self.carried.index(name)]
        model, data = self.arm.robot.model, self.arm.robot.model.createData()
        pin.forwardKinematics(model, data, q)
        return np.asarray((data.oMi[joint] * placement).translation)


class PairWorld:
    """The links of one arm against those of another.

    Attributes:
        one_levers, other_levers: (pairs, dof) [m] levers of the first and the second shape of each pair.
    """

    def __init__(self, one: ArmBody, other: ArmBody) -> None:
        """Pair all moving shapes.

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
        self._carried = [first >= len(one.arm.hulls.links), second >= len(other.arm.hulls.links)]

    def gripper_on(self, touching: int, name: str) -> NDArray[np.bool_]:
        """Return (pairs,) which are the gripper of arm `touching`, 0 or 1, and an object that the other one carries."""
        held, gripper = 1 - touching, (self.one, self.other)[touching].arm.gripper
        named = np.array([pair[touching] in gripper and pair[held] == name for pair in self._names])
        return np.asarray(named & self._carried[held] & ~self._carried[touching])

    def distances(self, q_one: Array, q_other: Array) -> tuple[Array, Array]:
        """Return (pairs,) [m] upper and lower bounds of all distances."""
        return self._kernel.distances(np.concatenate([q_one, q_other]))

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
