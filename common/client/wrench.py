"""The wrench at the tool of an arm as an array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from common.errors import ZencellError
from common.messages import Vector3, Wrench

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
