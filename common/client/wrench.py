"""The wrench at the tool of an arm, for a program."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.client.subscriptions import Part, Subscriptions
from common.config import check
from common.errors import ZencellError
from common.messages import Vector3, Wrench, ZeroWrench
from common.transport.bus import Bus

TIMEOUT = 5.0  # [s] wall for an answer


class NoWrench(ZencellError):
    """The arm has no force sensor, or it does not report; with the reason."""

    exit_code = 1


def as_array(wrench: Wrench) -> NDArray[np.float64]:
    """Return force [N] and torque [N m] of a message as (6,).

    Raises:
        NoWrench: the message has none.
    """
    if wrench.force is None or wrench.torque is None:
        raise NoWrench(wrench.reason)
    return np.array([*_three(wrench.force), *_three(wrench.torque)])


def _three(vector: Vector3) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


class WrenchArm(Part):
    """What an arm feels."""

    owner: str
    _subscriptions: Subscriptions
    _bus: Bus

    async def wrench(self) -> NDArray[np.float64]:
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
