"""Joint positions for goals that leave some freedom: of all that will do, those that take the least time.

Where the tool may end in a region, at one of several goals or on the way through such, positions are drawn, ranked by
the time that the motion through them takes, and moved towards less as long as they stay in their regions and free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.free_axes import chooses, converge_in, solve_in, why_not_in
from common.planning.goal_sampling import GoalSamples, missed_by, sample_goals, sample_pose
from common.planning.ik import converge
from common.planning.path import blended_path
from common.planning.problem import Arc, Cancel, GoalChoice, Part, Problem, Region, Result
from common.planning.retiming import RetimingFailed, TooLong, parametrise
from common.robot.model import RobotModel
from common.robot.transforms import transform
from common.time_source import monotonic

Array = NDArray[np.float64]
Choices = tuple[Array | Region, ...]

DRAWS = 100  # chains of positions of which the quickest are looked at
CLOSELY = 24  # of them whose time is found out
STARTS = 3  # of them that are free, from which it is gone on
MOVES = 60  # tries to make one of these quicker
_FIRST_MOVE, _LEAST_MOVE = 0.3, 0.02  # [rad] of a joint in such a try
_HOPELESS = 1.3  # times the rough time of the best: such a try is not looked at closely
_PATIENCE = 10  # tries in a row that gain nothing, before they become smaller
_SHARE = 0.5  # of the time for planning that this may take
_ITERATIONS = 30
_SAME = 1e-6  # [rad]
_COARSE = 0.1  # [rad] between grid points where a time is estimated
_BEND, _LEAST_CUT = 0.02, 0.02  # [rad] step by which bends are looked at without the kernel; smaller cuts are stops
_ROUNDED = 0.97  # of the radius within which a corner may be rounded off


@dataclass(frozen=True)
class Chain:
    """Positions (N, dof) [rad] from the start through one of each goal; about how long that takes [s].

    `cuts` (N,) [rad] is what may be rounded off before and after each; `free`: the straight edges between them are.
    """

    positions: Array
    cuts: Array
    seconds: float
    free: bool = False


def nearest_in(region: Region, T_world_tcp: Array) -> Array:
    """The (4, 4) pose of a region that is near another: position, tilt and yaw are each brought to the bounds."""
    T = region.T_world_tcp
    low, high = T[:3, 3] - region.half_sides, T[:3, 3] + region.half_sides
    turned = T[:3, :3].T @ T_world_tcp[:3, :3]
    tilt = math.acos(float(np.clip(turned[2, 2], -1, 1)))
    axis = np.array([-turned[1, 2], turned[0, 2], 0.0])
    length = float(np.linalg.norm(axis))
    axis = axis / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    flat = pin.exp3(tilt * axis).T @ turned
    yaw = min(max(math.atan2(flat[1, 0], flat[0, 0]), -region.yaw), region.yaw)
    turn = pin.exp3(np.array([0.0, 0.0, yaw]))
    return transform(T[:3, :3] @ pin.exp3(min(tilt, region.tilt) * axis) @ turn,
                     np.clip(T_world_tcp[:3, 3], low, high))


def chains(problem: Problem, parts: Sequence[Part], cancel: Cancel) -> list[Chain] | Result:
    """Chains from the start through all parts, the quickest first, those that are free before the others; or why none.

    The goals of the parts are joint positions, regions, or several of these to choose from.
    """
    given = [_choices(part) for part in parts]
    until = monotonic() + _SHARE * max(0.0, problem.seconds_left)
    drawn = sorted(_drawn(problem, given, until), key=lambda draw: _roughly(problem, draw))
    usable = [positions for positions in drawn if not any(problem.world.collides(q) for q in positions[1:])]
    if not usable:
        return _why_none(problem, parts, cancel)
    looked_at = [chain for positions in usable[:CLOSELY] if (chain := _timed(problem, parts, positions)) is not None]
    looked_at.sort(key=lambda chain: chain.seconds)
    found: list[Chain] = []
    for chain in looked_at:
        if (checked := _checked(problem, chain)).free:
            found.append(checked)
        if len(found) >= STARTS or cancel.reason(problem) or monotonic() > until:
            break
    better = [_moved(problem, parts, given, chain, until) for chain in found]
    better = better or looked_at[:STARTS]  # the way is for planners to find
    return sorted(better, key=lambda chain: chain.seconds)


def quicker_goals(problem: Problem, goals: Sequence[Array]) -> list[Array]:
    """Free positions (dof,) [rad] of a goal, the quickest to turn to first; the best of them moved to less time."""
    assert isinstance(problem.goal, Region | GoalChoice)
    parts = [Part(problem.goal)]
    until = monotonic() + _SHARE * max(0.0, problem.seconds_left)
    timed = (_timed(problem, parts, np.array([problem.start, goal])) for goal in goals)
    ranked = sorted((chain for chain in timed if chain is not None), key=lambda chain: chain.seconds)
    for chain in ranked[:STARTS]:
        if (checked := _checked(problem, chain)).free:
            moved = _moved(problem, parts, [_choices(parts[0])], checked, until)
            return [moved.positions[-1], *(chain.positions[-1] for chain in ranked)]
    return [chain.positions[-1] for chain in ranked]


def _choices(part: Part) -> Choices:
    assert not isinstance(part.goal, Arc)
    return part.goal.goals if isinstance(part.goal, GoalChoice) else (part.goal,)


def _drawn(problem: Problem, given: Sequence[Choices], until: float) -> Iterator[Array]:
    """Chains (N + 1, dof): the last of the goals anywhere in it, those before on the way there."""
    robot, rng, start = problem.robot, problem.rng, problem.start
    for attempt in range(DRAWS if any(len(some) > 1 or isinstance(some[0], Region) for some in given) else 1):
        if monotonic() > until and attempt:
            return
        ends = given[-1]
        end = ends[attempt % len(ends)]
        last: Array | None = end if isinstance(end, np.ndarray) else None
        if isinstance(end, Region):
            spread = (0.0, 0.5, 0.5, 1.5)[(attempt // len(ends)) % 4]
            seed = start if attempt < len(ends) else start + rng.normal(0.0, 1.0, robot.dof) * spread
            T = nearest_in(end, robot.fk(start)) if attempt < len(ends) else sample_pose(end, rng)
            seed = np.clip(seed, robot.lower, robot.upper)
            if chooses(robot):
                last = converge(robot, pin.SE3(T), seed, _ITERATIONS)
            else:
                there = transform(end.T_world_tcp[:3, :3], T[:3, 3])
                last = solve_in(robot, replace(end, T_world_tcp=there, half_sides=np.zeros(3)), seed)
        if last is None:
            continue
        chain = [start]
        for number, between in enumerate(given[:-1], 1):
            share = rng.uniform(0.0, 1.0) if len(given) == 2 else number / len(given)
            q = _brought_in(robot, between, start + share * (last - start))
            if q is None:
                break
            chain.append(q)
        if len(chain) == len(given):
            yield np.array([*chain, last])


def _brought_in(robot: RobotModel, goals: Choices, q: Array) -> Array | None:
    """The positions (dof,) [rad] next to q at which the nearest of several goals is reached."""
    T = robot.fk(q)

    def away(goal: Array | Region) -> float:
        return missed_by(goal, T) if isinstance(goal, Region) else float(np.abs(goal - q).max())

    goal = min(goals, key=away)
    if not isinstance(goal, Region):
        return goal
    if missed_by(goal, T) > 0.0 and not chooses(robot):
        return converge_in(robot, goal, q, _ITERATIONS)
    return q if missed_by(goal, T) <= 0.0 else converge(robot, pin.SE3(nearest_in(goal, T)), q, _ITERATIONS)


def _roughly(problem: Problem, positions: Array) -> float:
    """About how long straight edges through positions (N, dof) take [s], without a stop between."""
    edges = np.abs(np.diff(positions, axis=0))
    speeding = math.sqrt(float((edges.sum(axis=0) / problem.acceleration).max()))
    return float((edges / problem.velocity).max(axis=1).sum()) + 2 * speeding


def _timed(problem: Problem, parts: Sequence[Part], positions: Array) -> Chain | None:
    """A chain with its time, that is not looked at for collisions; None where it cannot be timed."""
    if not (np.abs(np.diff(positions, axis=0)).max(axis=1) > _SAME).all():  # it rests somewhere
        return Chain(positions, np.zeros(len(positions)), _roughly(problem, positions))
    cuts = _cuts(problem.robot, parts, positions)
    seconds = _seconds(problem, positions, cuts)
    return None if seconds is None else Chain(positions, cuts, seconds)


def _seconds(problem: Problem, positions: Array, cuts: Array) -> float | None:
    if len(positions) == 2:  # the slowest joint sets the pace of the straight edge
        edge = np.abs(positions[1] - positions[0])
        slowest, hardest = float((edge / problem.velocity).max()), float((edge / problem.acceleration).max())
        return slowest + hardest / slowest if hardest < slowest**2 else 2 * math.sqrt(hardest)
    try:
        return sum(parametrise(path, problem.velocity, problem.acceleration, step=_COARSE).duration
                   for path in blended_path(positions, cuts))
    except (RetimingFailed, TooLong):
        return None


def _checked(problem: Problem, chain: Chain) -> Chain:
    """The chain, free where its edges are, with corners that are as round as they can be."""
    if not all(problem.world.edge_free(a, b) for a, b in pairwise(chain.positions)):
        return chain
    cuts, seconds = chain.cuts, chain.seconds
    while cuts.any() and not all(problem.world.bends_free(p, _BEND) for p in blended_path(chain.positions, cuts)):
        cuts = np.where(cuts > _LEAST_CUT, 0.5 * cuts, 0.0)
        seconds = _seconds(problem, chain.positions, cuts) or math.inf
    return replace(chain, cuts=cuts, seconds=seconds, free=True)


def _cuts(robot: RobotModel, parts: Sequence[Part], positions: Array) -> Array:
    """(N,) [rad] how much of the edges at each position may be rounded off within the blend radius of its part."""
    cuts = np.zeros(len(positions))
    edges = np.diff(positions, axis=0)
    spans = np.linalg.norm(edges, axis=1)
    for i, part in enumerate(parts[:-1], 1):
        if not part.blend_radius:
            continue
        cut = 0.5 * float(min(spans[i - 1], spans[i]))
        corner = robot.fk(positions[i])[:3, 3]
        for _ in range(8):
            ends = (positions[i] - cut / spans[i - 1] * edges[i - 1], positions[i] + cut / spans[i] * edges[i])
            away = max(float(np.linalg.norm(robot.fk(q)[:3, 3] - corner)) for q in ends)
            if away <= part.blend_radius:
                break
            cut *= _ROUNDED * part.blend_radius / away
        cuts[i] = cut
    return cuts


def _moved(problem: Problem, parts: Sequence[Part], given: Sequence[Choices], chain: Chain, until: float) -> Chain:
    """The chain, moved in small steps towards less time."""
    robot, rng, size, idle = problem.robot, problem.rng, _FIRST_MOVE, 0
    fixed = [all(isinstance(goal, np.ndarray) for goal in some) for some in given]
    if all(fixed):
        return chain
    for _ in range(MOVES):
        if monotonic() > until:
            break
        positions = chain.positions.copy()
        only = int(rng.integers(0, len(given) + 1))  # one of them, or all
        for i, choices in enumerate(given, 1):
            if fixed[i - 1] or only not in (0, i):
                continue
            q = np.clip(positions[i] + rng.normal(0.0, size, robot.dof), robot.lower, robot.upper)
            brought = _brought_in(robot, choices, q)
            if brought is None:
                break
            positions[i] = brought
        else:
            tried = _quicker(problem, parts, positions, chain)
            if tried is not None:
                chain, idle = tried, 0
                continue
        idle += 1
        if idle >= _PATIENCE:
            size, idle = 0.5 * size, 0
            if size < _LEAST_MOVE:
                break
    return chain


def _quicker(problem: Problem, parts: Sequence[Part], positions: Array, chain: Chain) -> Chain | None:
    if _roughly(problem, positions) > _HOPELESS * _roughly(problem, chain.positions):
        return None
    tried = _timed(problem, parts, positions)
    if tried is None or tried.seconds >= chain.seconds or any(problem.world.collides(q) for q in positions[1:]):
        return None
    tried = _checked(problem, tried)
    return tried if tried.free and tried.seconds < chain.seconds else None


def _why_none(problem: Problem, parts: Sequence[Part], cancel: Cancel) -> Result:
    """What keeps the arm from the first of the parts that no free positions were found for."""
    for number, part in enumerate(parts, 1):
        samples = GoalSamples()
        for goal in _choices(part):
            samples = sample_goals(problem, goal, cancel, wanted=1, tries=20)
            if samples.goals:
                break
        if not samples.goals:
            failure = samples.failure(cancel.reason(problem))
            if failure.error == "no_ik" and isinstance(goal, Region) and not chooses(problem.robot):
                why = why_not_in(problem.robot, goal, problem.start)
                failure = replace(failure, message=f"{failure.message}: {why}")
            where = f"item {number} of {len(parts)}: " if len(parts) > 1 else ""
            return replace(failure, message=f"{where}{failure.message}", fraction=(number - 1) / len(parts))
    return Result(error=cancel.reason(problem) or "no_ik", message="no positions lead through all items")
