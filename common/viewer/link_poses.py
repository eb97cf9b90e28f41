"""Where the robot's links are, for joint states as they come: any joints, in any order, some perhaps unknown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.robot.model import RobotModel

Array = NDArray[np.float64]

_STILL = 1e-6  # [rad or m] a joint that moves by less has not moved: 1 micrometre at 1 m


class LinkPoses:
    """Forward kinematics of all joints, in world. Has working data of its own."""

    def __init__(self, robot: RobotModel) -> None:
        """Start with the group at home and other joints where the robot file locks them."""
        self._model = robot.full_model
        self._data = self._model.createData()
        self._q = robot.full_reference.copy()
        self._index = {name: self._model.joints[i].idx_q for i, name in enumerate(self._model.names) if i}
        self._frames = {f.name: i for i, f in enumerate(self._model.frames) if f.type == pin.FrameType.BODY}
        self._names: tuple[str, ...] = ()
        self._picked: list[int] = []
        self._slots: list[int] = []
        self.update(robot.joint_names, [float(value) for value in robot.named("home")])
        self._compute()

    def knows(self, link: str) -> bool:
        """Whether the robot has that link."""
        return link in self._frames

    def update(self, names: Sequence[str], positions: Sequence[float]) -> bool:
        """Take over joint positions [rad or m]; whether any has changed. Joints that the robot lacks are left out."""
        if tuple(names) != self._names:
            self._names = tuple(names)
            self._picked = [i for i, name in enumerate(names) if name in self._index]
            self._slots = [self._index[names[i]] for i in self._picked]
        values = np.asarray(positions, dtype=float)[self._picked]
        if (np.abs(values - self._q[self._slots]) < _STILL).all():
            return False
        self._q[self._slots] = values
        self._compute()
        return True

    def has_joint(self, name: str) -> bool:
        """Whether the robot has that joint."""
        return name in self._index

    def joint_positions(self, names: Sequence[str]) -> Array:
        """Positions [rad or m] of joints of the robot."""
        return np.asarray(self._q[[self._index[name] for name in names]])

    def pose(self, link: str) -> tuple[Array, Array]:
        """Position (3,) [m] and quaternion w, x, y, z (4,) of a link in world."""
        x = pin.SE3ToXYZQUAT(self._data.oMf[self._frames[link]])
        return x[:3], x[[6, 3, 4, 5]]

    @property
    def joints(self) -> list[tuple[str, int, int]]:
        """Name, index and index of the parent of each joint, parents first; 0 is the world."""
        return [(str(name), i, int(self._model.parents[i])) for i, name in enumerate(self._model.names) if i]

    def carrier(self, link: str) -> tuple[int, Array, Array]:
        """The joint that carries a link, and the link's position (3,) [m] and quaternion w, x, y, z (4,) in it."""
        frame = self._model.frames[self._frames[link]]
        x = pin.SE3ToXYZQUAT(frame.placement)
        return int(frame.parentJoint), x[:3], x[[6, 3, 4, 5]]

    def in_parents(self) -> Array:
        """(n, 7) position [m] and quaternion w, x, y, z of each of `joints` in the frame of its parent."""
        x = np.array([pin.SE3ToXYZQUAT(self._data.liMi[i]) for i in range(1, self._model.njoints)])
        return np.asarray(x[:, [0, 1, 2, 6, 3, 4, 5]])

    def _compute(self) -> None:
        pin.framesForwardKinematics(self._model, self._data, self._q)
