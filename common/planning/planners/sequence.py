"""Several motions in one trajectory.

`plan` follows point to point motions, straight lines and arcs, with blended corners. `join_segments` is the fallback of
every pipeline for sequences without lines and arcs: joint positions that are quick to pass, segments by any planner.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters
from common.planning.joint_goals import JointChain, joint_chains
from common.planning.joint_paths import blocked, line
from common.planning.planners import Plan, circ, lin, ptp
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, GoalSequence, Problem, Region, Result, SequenceItem
from common.planning.trajectory import join
from common.planning.waypoint_timing import BLENDS, ToolWaypoints, time_tool_path
from common.robot.model import RobotModel

Array = NDArray[np.float64]
Planners = Mapping[str, tuple[Plan, Parameters]]

SEGMENTS = "legs"  # name in a response, as clients know it
_MAX_CHAINS = 3  # through which paths are planned
_SAME = 1e-6  # [rad]
_STRAIGHT = 1e-5  # [rad] a waypoint this close to a line is on it


class Options(circ.Options):
    """Limits of the tool on lines and arcs, how finely they are followed, and IK solutions to choose from."""

    goals: int = Field(4, ge=1, le=100, description="IK solutions of a pose goal to choose from")


def plan(problem: Problem, options: Options, cancel: Cancel) -> Result:
    """Return one trajectory along all motions, or what ends one of them."""
    if not isinstance(problem.goal, GoalSequence):
        return Result(error=NOT_APPLICABLE, message="a sequence needs a sequence goal")
    items = problem.goal.items
    motions: list[ToolWaypoints] = []
    start = problem.start
    for number, item in enumerate(items):
        single = replace(problem, start=start, goal=item.goal, straight=item.straight)
        found = _motion(single, item, options, cancel)
        if isinstance(found, Result):
            fraction = (number + found.fraction) / len(items)
            error = "bad_goal" if found.error == NOT_APPLICABLE else found.error
            message = f"item {number + 1} of {len(items)}: {found.message}"
            return replace(found, error=error, fraction=fraction, message=message)
        motions.append(found)
        start = found.positions[-1]
    stretches = _blended(problem, items, motions)
    if isinstance(stretches, Result):
        return stretches
    return Result(trajectory=join([time_tool_path(problem, path, options) for path in stretches]), fraction=1.0)


def _motion(problem: Problem, item: SequenceItem, options: Options, cancel: Cancel) -> ToolWaypoints | Result:
    """Return waypoints of a single motion that is free, or what ends it."""
    if isinstance(item.goal, Arc):
        return circ.arc_waypoints(problem, item.goal, options, cancel)
    if item.straight:
        if not isinstance(item.goal, Region):
            return Result(error=NOT_APPLICABLE, message="a straight line of the tool needs a pose goal")
        return lin.line_waypoints(problem, item.goal, options, cancel)
    result = ptp.plan(problem, ptp.Options(goals=options.goals), cancel)
    if result.trajectory is None:
        return result
    goal = result.trajectory.positions[-1]
    # As close together as those of lines, so that the corner is located as exactly.
    rough = _tool_positions(problem.robot, line(problem.start, goal, 20))
    length = float(np.linalg.norm(np.diff(rough, axis=0), axis=1).sum())
    steps = max(20, round(length / options.step))
    return ToolWaypoints(line(problem.start, goal, steps), np.zeros((steps + 1, 2)))


def _blended(
    problem: Problem, items: tuple[SequenceItem, ...], motions: list[ToolWaypoints]
) -> list[ToolWaypoints] | Result:
    """Return stretches between stops, with blended corners inside; or the blend that does not fit or collides."""
    stretches: list[ToolWaypoints] = []
    pieces: list[ToolWaypoints] = []
    rest = motions[0]
    for number, following in enumerate(motions[1:], 1):
        radius = items[number - 1].blend_radius
        where = f"blend of items {number} and {number + 1} of {len(items)}"
        if radius == 0 or _is_still(rest) or _is_still(following):
            stretches.append(concatenated([*pieces, rest]))
            pieces, rest = [], following
            continue
        before, after = (_tool_positions(problem.robot, motion.positions) for motion in (rest, following))
        try:
            leave = blend_entry(before, after[0], radius)
            arrive = len(after) - 1 - blend_entry(after[::-1], after[0], radius)
        except NoBlend:
            message = f"{where}: blend_radius {radius:g} m reaches beyond the other end of one of them"
            return Result(error="bad_goal", message=message, waypoint=number, fraction=(number - 1) / len(items))
        corner = blend(rest.positions[leave:], following.positions[: arrive + 1])
        hit = blocked(problem, corner)
        if hit:
            return replace(hit, message=f"{where}: {hit.message}", fraction=number / len(items))
        pieces.append(ToolWaypoints(rest.positions[: leave + 1], rest.travel[: leave + 1]))
        limited = rest.travel.any() or following.travel.any()
        travel = _tool_travel(problem.robot, corner) if limited else np.zeros((len(corner), 2))
        pieces.append(ToolWaypoints(corner, travel))
        rest = ToolWaypoints(following.positions[arrive:], following.travel[arrive:])
    stretches.append(concatenated([*pieces, rest]))
    return stretches


def _is_still(motion: ToolWaypoints) -> bool:
    return bool(np.abs(motion.positions - motion.positions[0]).max() < 1e-6)


def _tool_positions(robot: RobotModel, positions: Array) -> Array:
    """Return (N, 3) positions of the tool [m]."""
    return np.array([robot.fk(q)[:3, 3] for q in positions])


def _tool_travel(robot: RobotModel, positions: Array) -> Array:
    """Return (N, 2) path length [m] and turn [rad] of the tool up to each position."""
    poses = np.array([robot.fk(q) for q in positions])
    length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    turn = [np.linalg.norm(pin.log3(R)) for R in turns]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([length, turn], axis=1), axis=0)])


class NoBlend(Exception):
    """A blend radius that contains the other end of one of the motions."""


def blend_entry(tool: Array, corner: Array, radius: float) -> int:
    """Return the first index of the tool's positions (N, 3) [m] from which it stays within a radius [m] of a corner.

    Raises:
        NoBlend: it is never farther away.
    """
    outside = np.flatnonzero(np.linalg.norm(tool - corner, axis=1) > radius)
    if not len(outside):
        raise NoBlend
    return int(outside[-1]) + 1


def blend(before: Array, after: Array) -> Array:
    """Return (N, dof) positions [rad] that lead from the first of `before` smoothly to the last of `after`.

    Both motions run at the same time, one to the corner (the last of `before` and the first of `after`) and the other
    from it, and a quintic weight moves from one to the other: q = a + w (b - a). So the path leaves and arrives in the
    directions of the two motions, and lies between them.
    """
    count = max(len(before), len(after))
    shares = np.linspace(0, 1, count)
    weights = (shares**3 * (10 - 15 * shares + 6 * shares**2))[:, None]
    a, b = resampled(before, shares), resampled(after, shares)
    return np.asarray(a + weights * (b - a))


def resampled(positions: Array, shares: Array) -> Array:
    """Return (M, dof) positions at shares (M,), 0 to 1, of the index range of positions (N, dof)."""
    place = shares * (len(positions) - 1)
    i = np.minimum(place.astype(int), max(len(positions) - 2, 0))
    following = np.minimum(i + 1, len(positions) - 1)
    part = (place - i)[:, None]
    return np.asarray((1 - part) * positions[i] + part * positions[following])


def concatenated(parts: list[ToolWaypoints]) -> ToolWaypoints:
    """Return the parts one after the other; each starts where the one before ends."""
    positions, travel = [parts[0].positions], [parts[0].travel]
    for part in parts[1:]:
        positions.append(part.positions[1:])
        travel.append(part.travel[1:] - part.travel[0] + travel[-1][-1])
    return ToolWaypoints(np.concatenate(positions), np.concatenate(travel))


class NoOptions(Parameters):
    """No options."""


def join_segments(problem: Problem, options: Parameters, cancel: Cancel, *, planners: Planners) -> Result:
    """Return one path through all goals of a sequence without lines and arcs, or why none was found.

    Args:
        problem: with a sequence goal.
        options: none.
        cancel: ends the search.
        planners: with their options, by name, in the order in which they are tried for each segment.
    """
    items = problem.sequence
    if items is None or any(item.straight or isinstance(item.goal, Arc) for item in items):
        return Result(error=NOT_APPLICABLE, message="lines and arcs in a sequence need a planner for these")
    found = joint_chains(problem, items, cancel)
    if isinstance(found, Result):
        return found
    worst = Result(error="no_path", message="no chain of joint positions can be timed")
    for chain in found[:_MAX_CHAINS]:
        result = _joined(problem, chain, planners, cancel)
        if not result.error:
            return result
        worst = result
        if cancel.reason(problem):
            break
    return worst


def _joined(problem: Problem, chain: JointChain, planners: Planners, cancel: Cancel) -> Result:
    """Return the path through a chain of joint positions, or the failure of its first segment without a path."""
    points, cuts, attempts, planner = [chain.positions[0]], [0.0], [], ""
    count = len(chain.positions) - 1
    for number, (a, b) in enumerate(pairwise(chain.positions), 1):
        result = _plan_segment(replace(problem, start=a, goal=b), planners, cancel)
        attempts += result.attempts
        if result.error:
            message = f"item {number} of {count}: {result.message}"
            return replace(result, message=message, fraction=(number - 1) / count, attempts=attempts)
        assert result.waypoints is not None
        path = _corners(result.waypoints)
        planner = result.planner if len(path) > 2 or not planner else planner
        points += list(path[1:])
        cuts += [BLENDS[0]] * (len(path) - 2) + [float(chain.cuts[number])]
    distinct = [0] + [i for i in range(1, len(points)) if np.abs(points[i] - points[i - 1]).max() > _SAME]
    if len(distinct) == 1:
        distinct.append(len(points) - 1)
    return Result(waypoints=np.array(points)[distinct], cuts=np.array(cuts)[distinct], fraction=1.0, planner=planner,
                  attempts=attempts)


def _plan_segment(problem: Problem, planners: Planners, cancel: Cancel) -> Result:
    """Return the waypoints of the first planner that succeeds, or the failure that got furthest."""
    best = Result(error=NOT_APPLICABLE, message="no planner of the pipeline finds paths through joint space")
    for name, (plan, options) in planners.items():
        result = plan(problem, options, cancel)
        if not result.error:
            if result.waypoints is None:
                assert result.trajectory is not None
                result = replace(result, waypoints=result.trajectory.positions)
            return replace(result, planner=name)
        if result.error != NOT_APPLICABLE and (best.error == NOT_APPLICABLE or result.fraction >= best.fraction):
            best = result
    return best


def _corners(path: Array) -> Array:
    """Return the waypoints (N, dof) [rad] without those on the straight line between their neighbours."""
    corners = [path[0]]
    for here, following in pairwise(path[1:]):
        edge, span = here - corners[-1], following - corners[-1]
        length = float(span @ span)
        if length > _SAME**2 and np.abs(edge - (edge @ span) / length * span).max() > _STRAIGHT:
            corners.append(here)
    return np.array([*corners, path[-1]])
