"""Inverse kinematics by the kernel."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from common.planning.kernel.world import NoKernel, address, joints_of

Array = NDArray[np.float64]


class KernelArm:
    """The chain of joints that carries a frame. Several threads may ask at once."""

    def __init__(self, model: pin.Model, frame: int, position_tolerance: float, rotation_tolerance: float) -> None:
        """Copy joints and limits.

        Args:
            model: joints; frame: index of the frame that is to be put somewhere.
            position_tolerance: [m]; rotation_tolerance: [rad].

        Raises:
            NoKernel: there is no library, or a joint is not known to it.
        """
        self._world = None
        self._library, self._world = joints_of(model)
        self._joint: int = model.frames[frame].parentJoint
        if not self._joint:
            raise NoKernel("no joint moves the frame")
        self._tip = np.array(model.frames[frame].placement.homogeneous[:3])
        self._tolerance = np.array([position_tolerance, rotation_tolerance])
        self._fixed = (self._world, self._joint, address(self._tip), address(self._tolerance))
        self._shape = (model.nq,)

    def __del__(self) -> None:
        if self._world:
            self._library.zk_free(self._world)

    def solve(
        self, T_world_frame: ArrayLike, seed: ArrayLike, *, restarts: int, iterations: int, random: int = 0
    ) -> Array | None:
        """Joint positions (dof,) [rad] within the limits that put the frame at a (4, 4) pose; None when none was found.

        Args:
            seed: (dof,) [rad] where the search starts, clipped to the limits.
            restarts: random starts after that, which `random` decides; iterations: steps from the seed.
        """
        pose, q = np.asarray(T_world_frame, dtype=float), np.array(seed, dtype=float, order="C")
        if pose.shape != (4, 4) or q.shape != self._shape:
            raise ValueError(f"pose has shape {pose.shape}, seed {q.shape}")
        target = np.ascontiguousarray(pose[:3])
        starts = self._library.zk_ik(*self._fixed, address(target), restarts, iterations, random, address(q))
        return None if starts < 0 else q
