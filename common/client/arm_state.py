"""The state of an arm, for a program: joints, tool pose, motion, its controller, and the wrench at the tool."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.client.subscriptions import NothingReceived, Part, Subscriptions
from common.client.wrench import TIMEOUT, as_array
from common.config import check
from common.messages import JointState, MotionStatus, RobotDescription, RobotStatus, ZeroWrench
from common.transport.bus import Bus

Array = NDArray[np.float64]


class ArmState(Part):
    """The newest state of an arm."""

    owner: str  # client name in its requests
    _subscriptions: Subscriptions
    _bus: Bus
    _tf: Callable[[str, str], Coroutine[Any, Any, Array]]

    async def description(self) -> RobotDescription:
        """Return the names of its joints, limits, named poses, and the frame of its tool."""
        return await self._subscriptions.latest(topics.ROBOT_DESCRIPTION)

    async def joints(self) -> Array:
        """Return its positions (dof,) [rad or m], in the order of `description().joints`."""
        return (await self._measured())[0]

    async def velocities(self) -> Array:
        """Return its velocities (dof,) [rad/s or m/s]."""
        return (await self._measured())[1]

    async def _measured(self) -> tuple[Array, Array]:
        names = (await self.description()).joints
        state: JointState = await self._subscriptions.next(topics.JOINT_STATES)
        q = dict(zip(state.name, state.position, strict=True))
        dq = dict(zip(state.name, state.velocity or [0.0] * len(state.name), strict=True))
        missing = [name for name in names if name not in q]
        if missing:
            raise NothingReceived(f"{self._bus.cell}/joint_states of {', '.join(missing)}")
        return np.array([q[name] for name in names]), np.array([dq[name] for name in names])

    async def pose(self, frame: str = "world") -> Array:
        """Return the pose (4, 4) of the tool centre point in a frame."""
        return await self._tf(frame, (await self.description()).tcp)

    async def status(self) -> MotionStatus:
        """Return its goal, its progress, and the operator who stopped or holds it."""
        return await self._subscriptions.query(topics.MOTION_STATUS)

    async def robot(self) -> RobotStatus:
        """Return the state of its own controller: mode, why it cannot move, speed slider, inputs and outputs."""
        return await self._subscriptions.query(topics.ROBOT_STATUS)

    async def wrench(self) -> Array:
        """Return what the environment exerts on the tool: force [N] and torque [N m] (6,) from now on.

        They act at the tool centre point, along the axes of the tool, without the weight of gripper and held object.

        Raises:
            NoWrench: the arm has no force sensor, or it does not report; with the reason.
        """
        return as_array(await self._subscriptions.next(topics.WRENCH))

    async def zero_wrench(self) -> None:
        """Take the present wrench as zero. Nothing must touch the tool.

        Raises:
            RemoteError: the arm moves, has no force sensor, or another client has motion authority; see `code`.
        """
        request = check(ZeroWrench, {"header": self._bus.header(), "owner": self.owner}, "zero_wrench")
        await self._bus.client(topics.WRENCH_ZERO).call(request, TIMEOUT)
