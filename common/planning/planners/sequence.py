"""Several motions in one trajectory: point to point, straight lines and arcs, with corners rounded off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common.planning.joint_goals import blocked, line
from common.planning.planners import circ, lin, ptp
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, GoalSequence, Part, Problem, Region, Result
from common.planning.retiming import join
from common.planning.timing import ToolWaypoints, follow_in_time
from common.robot.model import RobotModel

Array = NDArray[np.float64]


class Options(circ.Options):
    """Limits of the tool on lines and arcs, how finely they are followed, and IK solutions to choose from."""

    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """One trajectory along all motions, or what ends one of them: nothing is begun that cannot be finished."""
    if not isinstance(problem.goal, GoalSequence):
        return Result(error=NOT_APPLICABLE, message="a sequence needs a sequence goal")
    parts = problem.goal.parts
    motions: list[ToolWaypoints] = []
    start = problem.start
    for number, part in enumerate(parts):
        single = replace(problem, start=start, goal=part.goal, straight=part.straight)
        found = _motion(single, part, options, cancel)
        if isinstance(found, Result):
            fraction = (number + found.fraction) / len(parts)
            error = "bad_goal" if found.error == NOT_APPLICABLE else found.error
            message = f"item {number + 1} of {len(parts)}: {found.message}"
            return replace(found, error=error, fraction=fraction, message=message)
        motions.append(found)
        start = found.positions[-1]
    stretches = _blended(problem, parts, motions)
    if isinstance(stretches, Result):
        return stretches
    return Result(trajectory=join([follow_in_time(problem, path, options) for path in stretches]), fraction=1.0)


def _motion(problem: Problem, part: Part, options: Options, cancel: Cancel) -> ToolWaypoints | Result:
    """Waypoints of a single motion that is free, or what ends it."""
    if isinstance(part.goal, Arc):
        return circ.arc_waypoints(problem, part.goal, options, cancel)
    if part.straight:
        if not isinstance(part.goal, Region):
            return Result(error=NOT_APPLICABLE, message="a straight line of the tool needs a pose goal")
        return lin.line_waypoints(problem, part.goal, options, cancel)
    result = ptp.plan(problem, ptp.Options(goals=options.goals), cancel)
    if result.trajectory is None:
        return result
    goal = result.trajectory.positions[-1]
    # As close together as those of lines, so that the corner is found as exactly.
    rough = _tool(problem.robot, line(problem.start, goal, 20))
    way = float(np.linalg.norm(np.diff(rough, axis=0), axis=1).sum())
    steps = max(20, round(way / options.step))
    return ToolWaypoints(line(problem.start, goal, steps), np.zeros((steps + 1, 2)))


def _blended(
    problem: Problem, parts: tuple[Part, ...], motions: list[ToolWaypoints]
) -> list[ToolWaypoints] | Result:
    """Stretches between stops, with blends at the corners inside them; or the blend that does not fit or collides."""
    stretches: list[ToolWaypoints] = []
    pieces: list[ToolWaypoints] = []
    rest = motions[0]
    for number, following in enumerate(motions[1:], 1):
        radius = parts[number - 1].blend_radius
        where = f"blend of items {number} and {number + 1} of {len(parts)}"
        if radius == 0 or _still(rest) or _still(following):
            stretches.append(joined([*pieces, rest]))
            pieces, rest = [], following
            continue
        tool_before, tool_after = _tool(problem.robot, rest.positions), _tool(problem.robot, following.positions)
        try:
            leave = entry(tool_before, tool_after[0], radius)
            arrive = len(tool_after) - 1 - entry(tool_after[::-1], tool_after[0], radius)
        except NoBlend:
            message = f"{where}: blend_radius {radius:g} m reaches beyond the other end of one of them"
            return Result(error="bad_goal", message=message, waypoint=number, fraction=(number - 1) / len(parts))
        corner = blend(rest.positions[leave:], following.positions[: arrive + 1])
        hit = blocked(problem, corner)
        if hit:
            return replace(hit, message=f"{where}: {hit.message}", fraction=number / len(parts))
        pieces.append(ToolWaypoints(rest.positions[: leave + 1], rest.ways[: leave + 1]))
        limited = rest.ways.any() or following.ways.any()
        ways = _ways(problem.robot, corner) if limited else np.zeros((len(corner), 2))
        pieces.append(ToolWaypoints(corner, ways))
        rest = ToolWaypoints(following.positions[arrive:], following.ways[arrive:])
    stretches.append(joined([*pieces, rest]))
    return stretches


def _still(motion: ToolWaypoints) -> bool:
    return bool(np.abs(motion.positions - motion.positions[0]).max() < 1e-6)


def _tool(robot: RobotModel, positions: Array) -> Array:
    """(N, 3) positions of the tool [m]."""
    return np.array([robot.fk(q)[:3, 3] for q in positions])


def _ways(robot: RobotModel, positions: Array) -> Array:
    """(N, 2) way [m] and turn [rad] of the tool up to each position."""
    poses = np.array([robot.fk(q) for q in positions])
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    turn = [np.linalg.norm(pin.log3(R)) for R in turns]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([way, turn], axis=1), axis=0)])


class NoBlend(Exception):
    """A radius within which one of the motions begins or ends."""


def entry(tool: Array, corner: Array, radius: float) -> int:
    """Index of the first of the tool's positions (N, 3) [m] from which on it stays within a radius [m] of a corner.

    Raises:
        NoBlend: it never is farther away.
    """
    outside = np.flatnonzero(np.linalg.norm(tool - corner, axis=1) > radius)
    if not len(outside):
        raise NoBlend
    return int(outside[-1]) + 1


def blend(before: Array, after: Array) -> Array:
    """(N, dof) positions [rad] that lead from the first of `before` smoothly to the last of `after`.

    Both motions run at the same time, the one to the corner (which is the last of `before` and the first of `after`)
    and the other from it, and weight goes over from one to the other by a quintic: q = a + w (b - a). So the path
    leaves and arrives in the directions of the two motions, and lies between them.
    """
    count = max(len(before), len(after))
    shares = np.linspace(0, 1, count)
    weights = (shares**3 * (10 - 15 * shares + 6 * shares**2))[:, None]
    a, b = resampled(before, shares), resampled(after, shares)
    return np.asarray(a + weights * (b - a))


def resampled(positions: Array, shares: Array) -> Array:
    """(M, dof) positions at shares (M,) from 0 to 1 of the way through evenly counted ones (N, dof)."""
    place = shares * (len(positions) - 1)
    i = np.minimum(place.astype(int), max(len(positions) - 2, 0))
    following = np.minimum(i + 1, len(positions) - 1)
    part = (place - i)[:, None]
    return np.asarray((1 - part) * positions[i] + part * positions[following])


def joined(parts: list[ToolWaypoints]) -> ToolWaypoints:
    """The parts one after the other; each begins where the one before ends."""
    positions, ways = [parts[0].positions], [parts[0].ways]
    for part in parts[1:]:
        positions.append(part.positions[1:])
        ways.append(part.ways[1:] - part.ways[0] + ways[-1][-1])
    return ToolWaypoints(np.concatenate(positions), np.concatenate(ways))
