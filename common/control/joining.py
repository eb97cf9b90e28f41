"""Join a new trajectory to the goal that is followed, while it moves.

The path up to the join stays, the rest is replaced. The join is at a time of the path, not of the clock: holds and
changes of speed meanwhile leave it valid.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from common.control.goals import Goal, possible_share
from common.control.set_points import REWOUND
from common.control.trajectory import Tolerances, Trajectory, checked_trajectory
from common.errors import Refused
from common.hardware.interface import Limits
from common.messages import JointTrajectory

MAX_JOINED = 1000  # points of a trajectory that is joined: it is assessed within the control cycle
_ROUNDING = 1e-6  # of a share


class Join(NamedTuple):
    """The goal that is followed, and the time of its own trajectory [s] at which a new one starts."""

    goal: str
    time: float


def join_goal(
    running: Goal, name: str, message: JointTrajectory, time: float, limits: Limits, tolerances: Tolerances,
    period: float,
) -> Goal:
    """Return the goal that follows the running one up to a time [s] of its own trajectory, and then a new trajectory.

    Raises:
        Refused: that one is stopping, it is too late, the new one does not continue it, or set-points every `period`
            [s] would leave the limits.
    """
    if running.stopping:
        raise Refused("stopping", f"goal {running.id!r} is being stopped: {running.reason}")
    at, end = running.begin + time, running.trajectory.duration
    if not running.time + period <= at <= end + 1e-9:
        raise Refused("too_late", f"goal {running.id!r} is at {running.time - running.begin:.3f} s of its trajectory, "
                                  f"which ends at {end - running.begin:.3f} s: nothing can join it at {time:.3f} s")
    if len(message.points) > MAX_JOINED:
        raise Refused("too_many_points", f"trajectory has {len(message.points)} points; at most {MAX_JOINED} can join "
                                         "a goal that is followed")
    position, velocity = running.trajectory.at(at)
    rest = checked_trajectory(message, limits, position, tolerances, velocity)
    faded = running.time - REWOUND > running.blend
    path, dropped = splice(running.trajectory, at, rest, running.time - REWOUND if faded else 0.0)
    joined = replace(running, id=name, trajectory=path, begin=at - dropped, time=running.time - dropped,
                     blend=0.0 if faded else running.blend, _reported=0.0, _newest=None)
    if possible_share(joined, limits, period) < running.share - _ROUNDING:
        raise Refused("limit", "the joined motion exceeds limits of velocity, acceleration or jerk")
    return joined


def splice(lead: Trajectory, at: float, rest: Trajectory, keep_from: float = 0.0) -> tuple[Trajectory, float]:
    """Return the path that follows `lead` up to a time [s] and `rest` from there on, and the duration dropped from it.

    The path begins at the last point of `lead` that is not after `keep_from` [s].
    """
    first = max(int(np.searchsorted(lead.times, keep_from, side="right")) - 1, 0)
    last = max(int(np.searchsorted(lead.times, at - 1e-9)), first + 1)
    part, begin = slice(first, last), float(lead.times[first])
    segments = lead.segments[:, part].copy()
    share = (at - lead.times[last - 1]) / (lead.times[last] - lead.times[last - 1])
    segments[:, -1] *= share ** np.arange(6)[:, None]
    return Trajectory(
        np.concatenate([lead.times[part], at + rest.times]) - begin,
        np.concatenate([lead.positions[part], rest.positions]),
        np.concatenate([lead.velocities[part], rest.velocities]),
        np.concatenate([lead.accelerations[part], rest.accelerations]),
        given=np.concatenate([segments, rest.segments], axis=1),
    ), begin
