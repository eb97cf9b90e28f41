"""The one exception of the proof: a gripper may touch what another arm, at rest, carries: a handover.

The motion names the object. The exception holds while the tool center point is near the object and slow, for the links
of the gripper and that object alone, and only against an arm at rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.planning.trajectory import TimedPath, sample
from common.robot.model import RobotModel

Array = NDArray[np.float64]

NEAR = 0.08  # [m] of the tool center point from the center of the object
FASTEST = 0.1  # [m/s] of the tool center point there
SLACK = 1.1  # on that speed
_STEP = 0.02  # [s]


@dataclass(frozen=True)
class Touch:
    """An object that the gripper of an arm may touch from `begin` to `end` of its motion, own time [s]."""

    object: str
    begin: float
    end: float


def touch_of(
    robot: RobotModel, carried: Mapping[str, Array], path: TimedPath, names: Sequence[str]
) -> Touch | None:
    """Return when the gripper may touch the named object on a path; None: it names none, or is never near.

    Args:
        robot: of the arm that moves.
        carried: centers (3,) [m] of what other arms carry, by name.
        path: of the arm.
        names: that the motion declares.

    Raises:
        ValueError: one line, why the exception is refused.
    """
    if not names:
        return None
    if len(names) > 1 or names[0] not in carried:
        raise ValueError(f"may_touch: {', '.join(names)} is not one object that another arm carries; choices: "
                         f"{', '.join(carried) or 'none'}")
    count = max(2, int(np.ceil(path.duration / _STEP)) + 1)
    times = np.linspace(0.0, path.duration, count)
    way = np.array([robot.fk(q)[:3, 3] for q in sample(path, times)])
    near = np.flatnonzero(np.linalg.norm(way - carried[names[0]], axis=1) <= NEAR)
    if not len(near):
        return None
    first, last = int(near[0]), int(near[-1])
    inside = slice(max(first - 1, 0), last + 2)
    speed = float((np.linalg.norm(np.diff(way[inside], axis=0), axis=1) / (times[1] - times[0])).max())
    if speed > FASTEST * SLACK:
        raise ValueError(f"may_touch: the tool moves at {speed:.2f} m/s near {names[0]}; at most {FASTEST:g} m/s "
                         f"within {NEAR:g} m of it")
    return Touch(names[0], float(times[first]) if first else -1.0, float(times[last]))
