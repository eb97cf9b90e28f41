"""Meet a moving target: approach, descend, stay, rise and brake, each while the tool moves with the target.

The tool's motion is the sum of the target's displacement and a motion in the target's own frame. The meeting time
is found by iteration: an approach of a given duration determines where the target is then, and so the trajectory; the
shortest approach is used whose joint motion is within all limits. All sections are quintics in time, so accelerations
are continuous.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.ik import converge
from common.planning.problem import NOT_APPLICABLE, Cancel, Moving, Problem, Result
from common.planning.trajectory import TimedPath

Array = NDArray[np.float64]

_STEP = 0.02  # [s] between IK solutions
_CHECK = 0.04  # [s] between checks against other moving objects
_LOW = 0.2  # [s] before the end of the approach: from then on the tool may be near them

_JUMP = 0.3  # [rad] in a step: another branch of the inverse kinematics
_GROWTH = 1.12  # of a section that is too quick
_SEVERAL = 40  # attempts


class Options(Parameters):
    """Durations of the sections before they are stretched to keep the limits."""

    least_approach: float = Field(0.4, gt=0, le=10, description="[s]")
    tool_speed: float = Field(0.7, gt=0, le=5, description="of the first attempt to approach [m/s]")
    descend: float = Field(0.45, gt=0, le=10, description="descend, and rise again [s]")
    brake: float = Field(0.35, gt=0, le=10, description="[s]")


@dataclass(frozen=True)
class Sections:
    """Durations [s]."""

    approach: float
    descend: float
    dwell: float
    brake: float

    @property
    def ends(self) -> Array:
        """(5,) times at which approach, descent, stay, rise and braking end [s]."""
        return np.cumsum([self.approach, self.descend, self.dwell, self.descend, self.brake])


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return the trajectory that meets the target earliest, or why none does."""
    goal = problem.goal
    if not isinstance(goal, Moving):
        return Result(error=NOT_APPLICABLE, message="tracking needs a moving goal")
    away = float(np.linalg.norm(problem.robot.fk(problem.start)[:3, 3] - goal.at(0.0)))
    approach = max(options.least_approach, away / options.tool_speed)
    sections = Sections(approach, options.descend, goal.dwell, options.brake)
    for _ in range(_SEVERAL):
        if stop := cancel.reason(problem):
            return Result(error=stop, message="planning ended early")
        way = goal.speed * (goal.lead + float(sections.ends[3]))
        if way > goal.travel:
            message = f"the target would have moved {way:.2f} m, at most {goal.travel:.2f} m"
            return Result(error="too_late", message=message)
        path = _joint_path(problem, goal, sections)
        if isinstance(path, Result):
            sections = Sections(_GROWTH * sections.approach, sections.descend, sections.dwell, sections.brake)
            failure = path
            continue
        trajectory, late = path
        if late is None:
            meet = float(sections.ends[1])
            return _clear_of_moving(problem, goal, sections, trajectory) or Result(
                trajectory=trajectory, fraction=1.0, meet=meet)
        failure = Result(error="limit", message="joint limits allow no such motion")
        first = float(sections.ends[0])
        slower = [_GROWTH if late < first else 1.0, _GROWTH if first <= late <= sections.ends[3] else 1.0,
                  _GROWTH if late > sections.ends[3] else 1.0]
        sections = Sections(slower[0] * sections.approach, slower[1] * sections.descend, sections.dwell,
                            slower[2] * sections.brake)
    return failure


def _joint_path(problem: Problem, goal: Moving, sections: Sections) -> tuple[TimedPath, float | None] | Result:
    """Return the trajectory and the first time at which it exceeds a limit [s], or None; or why there is none."""
    end = float(sections.ends[-1])
    times = np.linspace(0.0, end, max(4, math.ceil(end / _STEP)) + 1)
    q, path = problem.start, [problem.start]
    for time, T in zip(times[1:], tool_poses(problem.robot.fk(problem.start), goal, sections, times)[1:], strict=True):
        # From the position before: an extrapolated guess would continue motions that do not move the tool.
        found = converge(problem.robot, pin.SE3(T), q, 20)
        if found is None or np.abs(found - q).max() > _JUMP:
            x, y, z = T[:3, 3]
            return Result(error="no_ik", message=f"the arm cannot be at ({x:.2f}, {y:.2f}, {z:.2f}) after {time:.2f} s",
                          fraction=float(time / end))
        q = found
        path.append(q)
    positions = np.array(path)
    velocities, accelerations = clamped_spline(times, positions)
    jerk = np.abs(np.diff(accelerations, axis=0)) / np.diff(times)[:, None]
    over = np.maximum(np.abs(velocities) / problem.velocity, np.abs(accelerations) / problem.acceleration).max(axis=1)
    over[1:] = np.maximum(over[1:], (jerk / problem.jerk).max(axis=1))
    late = float(times[int(np.argmax(over > 1.0))]) if over.max() > 1.0 else None
    return TimedPath(times, positions, velocities, accelerations), late


def tool_poses(T_start: Array, goal: Moving, sections: Sections, times: Array) -> Array:
    """Return (N, 4, 4) poses of the TCP at times (N,) [s] after the start, from a pose (4, 4) at rest."""
    a, b, c, d, e = sections.ends
    raised = np.array([0.0, 0.0, goal.approach])
    meets, leaves = (goal.at(float(t)) + raised for t in (a, d))
    turn = pin.log3(T_start[:3, :3].T @ goal.T_world_tcp[:3, :3])
    stopped = leaves + goal.velocity * (e - d) / 2  # a quintic from a speed to rest covers half the way
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for T, t in zip(poses, times.tolist(), strict=True):
        T[:3, :3] = T_start[:3, :3] @ pin.exp3(_smooth(t / a) * turn)
        if t < a:
            T[:3, 3] = _quintic(t / a, a, T_start[:3, 3], meets, 0 * goal.velocity, goal.velocity)
        elif t <= d:
            height = 1 - _smooth((t - a) / (b - a)) if t < b else 0.0 if t < c else _smooth((t - c) / (d - c))
            T[:3, 3] = goal.at(t) + height * raised
        else:
            T[:3, 3] = _quintic((t - d) / (e - d), e - d, leaves, stopped, goal.velocity, 0 * goal.velocity)
    return poses


def _smooth(u: float) -> float:
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _quintic(u: float, seconds: float, p0: Array, p1: Array, v0: Array, v1: Array) -> Array:
    """Return the position at a share u of a quintic between two states without acceleration."""
    d0, d1 = v0 * seconds, v1 * seconds
    way = p1 - p0
    return np.asarray(p0 + u * d0 + u**3 * (10 * way - 6 * d0 - 4 * d1) + u**4 * (-15 * way + 8 * d0 + 7 * d1)
                      + u**5 * (6 * way - 3 * d0 - 3 * d1))


def clamped_spline(times: Array, positions: Array) -> tuple[Array, Array]:
    """Return velocities and accelerations (N, dof) of the spline through positions (N, dof) with its ends at rest."""
    h = np.diff(times)
    slopes = np.diff(positions, axis=0) / h[:, None]
    matrix, right = np.zeros((len(times), len(times))), np.zeros_like(positions)
    matrix[0, 0] = matrix[-1, -1] = 1.0
    inner = np.arange(1, len(times) - 1)
    matrix[inner, inner - 1], matrix[inner, inner + 1] = h[1:], h[:-1]
    matrix[inner, inner] = 2 * (h[1:] + h[:-1])
    right[1:-1] = 3 * (h[1:, None] * slopes[:-1] + h[:-1, None] * slopes[1:])
    velocities = np.linalg.solve(matrix, right)
    begin = (6 * slopes - 4 * velocities[:-1] - 2 * velocities[1:]) / h[:, None]
    last = (-6 * slopes[-1:] + 2 * velocities[-2:-1] + 4 * velocities[-1:]) / h[-1]
    velocities[[0, -1]] = 0.0
    return np.asarray(velocities), np.concatenate([begin, last])


def _clear_of_moving(problem: Problem, goal: Moving, sections: Sections, trajectory: TimedPath) -> Result | None:
    """Return the first collision of the low part of the motion with a moving object, or None.

    All of them move as the target does. So the tool is put where it is relative to them, with the time stopped at the
    meeting.
    """
    if problem.moving is None:
        return None
    meet = float(sections.ends[1])
    world, q = problem.moving(goal.begin + meet), trajectory.positions[np.searchsorted(trajectory.times, meet)]
    times = np.arange(max(0.0, sections.approach - _LOW), float(sections.ends[3]), _CHECK)
    order = np.argsort(np.abs(times - meet))  # each from the arm at the meeting: the shifts are small
    poses = tool_poses(problem.robot.fk(problem.start), goal, sections, times)
    for index in order.tolist():
        time, T = float(times[index]), poses[index]
        T[:3, 3] -= (time - meet) * goal.velocity
        found = converge(problem.robot, pin.SE3(T), q, 30)
        if found is None:
            return Result(error="no_ik", message=f"objects near the target cannot be checked after {time:.2f} s")
        if pair := world.colliding_pair(found):
            message = f"after {time:.2f} s {pair[0]} collides with {pair[1]}, which moves"
            return Result(error="collision", message=message, colliding=pair, fraction=time / trajectory.duration)
    return None
