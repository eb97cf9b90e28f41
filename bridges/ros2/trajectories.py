"""Goals of FollowJointTrajectory as trajectories of the executor, with their tolerances and the reasons of refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import messages as m
from common.config import check
from common.errors import ConfigError, Refused
from common.hardware.interface import Vector

# Codes of results, of control_msgs/action/FollowJointTrajectory.
SUCCESSFUL, INVALID_GOAL, INVALID_JOINTS, OLD_HEADER_TIMESTAMP = 0, -1, -2, -3
PATH_TOLERANCE_VIOLATED, GOAL_TOLERANCE_VIOLATED = -4, -5
CODES = {
    "": SUCCESSFUL, "joint_names": INVALID_JOINTS, "old_stamp": OLD_HEADER_TIMESTAMP,
    "path_tolerance": PATH_TOLERANCE_VIOLATED, "goal_tolerance": GOAL_TOLERANCE_VIOLATED,
}
STAMP_TOLERANCE = 0.5  # [s] by which the start that a goal demands may be past or ahead


def code_of(error: str) -> int:
    """Return the code of a result for an error code of the cell."""
    return CODES.get(error, INVALID_GOAL)


@dataclass(frozen=True)
class Tolerances:
    """Positions tolerances [rad or m] of a goal by joint; a joint without one has that of the executor."""

    path: dict[str, float]
    goal: dict[str, float]

    @staticmethod
    def of(goal: Any) -> Tolerances:
        """Return those of a goal.

        Raises:
            Refused: there are some of other joints, or of velocities or accelerations.
        """
        if len(goal.component_path_tolerance) or len(goal.component_goal_tolerance):
            raise Refused("tolerance", "component tolerances: the arm has no joints of several degrees of freedom")
        return Tolerances(_positions("path_tolerance", goal.path_tolerance, goal.trajectory.joint_names),
                          _positions("goal_tolerance", goal.goal_tolerance, goal.trajectory.joint_names))


def _positions(field: str, given: Sequence[Any], names: Sequence[str]) -> dict[str, float]:
    for each in given:
        if each.name not in names:
            raise Refused("joint_names", f"{field} names joint {each.name!r}; choices: {', '.join(names)}")
        if each.velocity > 0 or each.acceleration > 0:
            raise Refused("tolerance", f"{field} of {each.name}: only tolerances of positions are supported")
    return {each.name: each.position for each in given if each.position > 0}


def violation(
    names: Sequence[str], desired: Vector, actual: Vector, tolerances: dict[str, float]
) -> str:
    """Return which joint is how far off, positions (dof,) [rad or m]; empty if all are within their tolerances."""
    for name, off in zip(names, np.abs(desired - actual).tolist(), strict=True):
        if off > tolerances.get(name, np.inf):
            return f"{name} is {off:.4f} off, tolerance {tolerances[name]:g}"
    return ""


def trajectory_of(goal: Any, measured: dict[str, float], now: int) -> m.JointTrajectory:
    """Return the trajectory of a goal; whether the arm can follow it is for the executor to say.

    As in the controllers of ros2_control it starts where the arm is, if its first point is later than 0. Points
    without velocities are joined by a spline that starts and ends at rest.

    Args:
        goal: a control_msgs/action/FollowJointTrajectory_Goal.
        measured: positions of the joints now [rad or m].
        now: cell time [ns].

    Raises:
        Refused: it is malformed, names other joints, or starts at another time.
    """
    given = goal.trajectory
    if goal.multi_dof_trajectory.joint_names or goal.multi_dof_trajectory.points:
        raise Refused("joint_names", "multi_dof_trajectory: the arm has no joints of several degrees of freedom")
    names = list(given.joint_names)
    if sorted(names) != sorted(measured):
        raise Refused("joint_names", f"the goal is for {', '.join(names) or 'no joints'}; choices: "
                                     f"{', '.join(measured)}, all of them")
    _require_now(given.header.stamp, now)
    times, (q, dq, ddq) = _arrays(given.points, len(names))
    if times[0] > 0:
        times = np.concatenate([[0.0], times])
        q = np.concatenate([[[measured[name] for name in names]], q])
        dq, ddq = (None if rows is None else np.concatenate([np.zeros_like(rows[:1]), rows]) for rows in (dq, ddq))
    if len(times) < 2 or not np.all(np.diff(times) > 0):
        raise Refused("bad_times", "time_from_start of the points must increase")
    if dq is None:
        dq, ddq = spline(times, q)
    ddq = np.zeros_like(dq) if ddq is None else ddq
    try:
        return check(m.JointTrajectory, {"joint_names": names, "points": [
            {"time_from_start": t, "positions": p, "velocities": v, "accelerations": a}
            for t, p, v, a in zip(times.tolist(), q.tolist(), dq.tolist(), ddq.tolist(), strict=True)]}, "trajectory")
    except ConfigError as error:
        raise Refused("malformed", str(error)) from None


def _require_now(stamp: Any, now: int) -> None:
    seconds = stamp.sec + stamp.nanosec * 1e-9
    if not seconds:
        return
    if (late := now * 1e-9 - seconds) > STAMP_TOLERANCE:
        raise Refused("old_stamp", f"trajectory.header.stamp is {late:.1f} s ago: 0 starts at once")
    if late < -STAMP_TOLERANCE:
        raise Refused("future_stamp", f"trajectory.header.stamp is {-late:.1f} s ahead: 0 starts at once, and a later "
                                      "start is not supported")


Rows = tuple[Vector, Vector | None, Vector | None]


def _arrays(points: Sequence[Any], dof: int) -> tuple[Vector, Rows]:
    """Return times (N,) [s], and positions, velocities and accelerations (N, dof), the last two if all points have."""
    if not points:
        raise Refused("too_few_points", "the trajectory has no points")
    found: list[NDArray[np.float64] | None] = []
    for field in ("positions", "velocities", "accelerations"):
        lengths = {len(getattr(point, field)) for point in points}
        if lengths == {0} and field != "positions":
            found.append(None)
        elif lengths == {dof}:
            found.append(np.array([getattr(point, field) for point in points], float))
        else:
            counts = " or ".join(map(str, sorted(lengths)))
            raise Refused("joint_names", f"points have {counts} {field} for {dof} joints")
    q, dq, ddq = found
    assert q is not None
    times = np.array([point.time_from_start.sec + point.time_from_start.nanosec * 1e-9 for point in points])
    return times, (q, dq, ddq)


def spline(times: Vector, q: Vector) -> tuple[Vector, Vector]:
    """Return velocities and accelerations (N, dof) of the cubic spline through q (N, dof) that is at rest at its ends.

    The accelerations at the ends are 0, so that the first and last segments, as quintics, begin and end smoothly.
    """
    h = np.diff(times)[:, None]
    slope = np.diff(q, axis=0) / h
    count = len(times)
    dq = np.zeros_like(q)
    # Accelerations are continuous: a tridiagonal system of the inner velocities, solved from both ends.
    upper = np.zeros(count)
    for i in range(1, count - 1):
        before, after = 1 / h[i - 1], 1 / h[i]
        pivot = 2 * (before + after) - before * upper[i - 1]
        upper[i] = (after / pivot)[0]
        dq[i] = (3 * (slope[i - 1] * before + slope[i] * after) - before * dq[i - 1]) / pivot
    for i in range(count - 2, 0, -1):
        dq[i] -= upper[i] * dq[i + 1]
    ddq = np.zeros_like(q)
    ddq[1:-1] = (2 * dq[:-2] + 4 * dq[1:-1] - 6 * slope[:-1])[: count - 2] / h[:-1]
    return dq, ddq
