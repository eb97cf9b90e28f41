"""Joint positions for goals that leave some freedom: free of collision, and those that take the least time first.

A goal may be a region of tool poses, one of several goals, or a sequence of such. Positions are drawn, ranked by the
time of the motion through them, and moved towards less time while they stay free and within their regions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.planning.goal_sampling import GoalSamples, distance_outside, nearest_pose_in, sample_goals, sample_pose
from common.planning.ik import (
    controls_full_pose,
    converge,
    converge_to_region,
    explain_region_unreachable,
    solve_region_ik,
)
from common.planning.path import blended_path
from common.planning.problem import NOT_APPLICABLE, Arc, Cancel, GoalChoice, Problem, Region, Result, SequenceItem
from common.planning.retiming import RetimingFailed, parametrise
from common.planning.trajectory import TooLong
from common.robot.model import RobotModel
from common.robot.transforms import transform
from common.time_source import monotonic

Array = NDArray[np.float64]
Choices = tuple[Array | Region, ...]

_MIN_TRIES = 4  # to find one IK solution of each of many poses
_MAX_EXPLAINED = 4  # goals of a set whose failures a message explains
_SAMPLES = 100  # chains of positions that are drawn
_MAX_TIMED = 24  # of these, the quickest by a rough estimate, are timed
_MAX_STARTS = 3  # free chains from which the optimisation starts
_MAX_MOVES = 60  # attempts to make one chain quicker
_FIRST_MOVE, _LEAST_MOVE = 0.3, 0.02  # [rad] of a joint in such an attempt
_HOPELESS = 1.3  # times the rough time of the best: such an attempt is not timed
_FAILURES_TO_SHRINK = 10  # failed attempts in a row that halve the moves
_TIME_SHARE = 0.5  # of the planning time that the optimisation may take
_ITERATIONS = 30
_SAME = 1e-6  # [rad]
_COARSE = 0.1  # [rad] between grid points where a time is estimated
_BLEND_STEP, _LEAST_CUT = 0.02, 0.02  # [rad] step that checks blends without the kernel; smaller cuts are stops
_ROUNDED = 0.97  # of the radius within which a corner may be rounded off


def joint_goals(problem: Problem, cancel: Cancel, *, wanted: int, tries: int = 40) -> list[Array] | Result:
    """Return free goal positions (dof,) [rad], those that take the least time first, or why there is none.

    Args:
        problem: with a joint goal, a region, or several of these to choose from. Other goals and straight lines of the
            tool do not apply.
        cancel: ends the search for IK solutions.
        wanted: IK solutions to look for, over all goals together, but at least one of each.
        tries: seeds and poses tried to find them.
    """
    if problem.straight:
        return Result(error=NOT_APPLICABLE, message="a path through joint space is no straight line of the tool")
    if isinstance(problem.goal, np.ndarray):
        return [problem.goal]  # the request's checks found it free
    if not isinstance(problem.goal, Region | GoalChoice):
        return Result(error=NOT_APPLICABLE, message="a path through joint space needs a joint goal or a pose goal")
    choices = problem.goal.goals if isinstance(problem.goal, GoalChoice) else (problem.goal,)
    wanted, tries = math.ceil(wanted / len(choices)), max(_MIN_TRIES, tries // len(choices))
    found: list[Array] = []
    failures: dict[int, Result] = {}
    for number, goal in enumerate(choices, 1):
        samples = sample_goals(problem, goal, cancel, wanted=wanted, tries=tries)
        found += samples.goals
        if not samples.goals:
            failures[number] = samples.failure(cancel.reason(problem))
    if found:
        return fastest_goals_first(problem, found)
    if (stop := cancel.reason(problem)) and len(choices) > 1:  # the other goals may not have been sampled yet
        return Result(error=stop, message=f"planning ended while {len(choices)} goals were sampled")
    for number in list(failures)[:_MAX_EXPLAINED]:
        failures[number] = _explained(problem, choices[number - 1], failures[number])
    return failures[1] if isinstance(problem.goal, Region) else no_goal_reachable(failures)


def _explained(problem: Problem, goal: Array | Region, failure: Result) -> Result:
    """Return the failure of a goal with the reason why the arm cannot reach it."""
    if failure.error != "no_ik" or not isinstance(goal, Region):
        return failure
    why = explain_region_unreachable(problem.robot, goal, problem.start)
    return replace(failure, message=f"{failure.message}: {why}")


def no_goal_reachable(failures: Mapping[int, Result]) -> Result:
    """Return the failure that got furthest, with the messages of the first few goals, by their numbers."""
    best = max(failures.values(), key=lambda failure: (failure.fraction, failure.colliding is not None))
    reasons = [f"goal {number}: {failures[number].message}" for number in sorted(failures)[:_MAX_EXPLAINED]]
    if len(failures) > _MAX_EXPLAINED:
        reasons.append(f"and {len(failures) - _MAX_EXPLAINED} more")
    return replace(best, message=f"none of {len(failures)} goals; {'; '.join(reasons)}", goal=None)


@dataclass(frozen=True)
class JointChain:
    """Positions (N, dof) [rad] from the start through one of each goal, and the estimated time [s].

    `cuts` (N,) [rad] may be rounded off before and after each position; `free`: the straight edges between are free.
    """

    positions: Array
    cuts: Array
    seconds: float
    free: bool = False


def joint_chains(problem: Problem, items: Sequence[SequenceItem], cancel: Cancel) -> list[JointChain] | Result:
    """Return chains from the start through all items, free ones first, then the quickest; or why there is none.

    The goals of the items are joint positions, regions, or several of these to choose from.
    """
    choices = [_choices(item) for item in items]
    until = monotonic() + _TIME_SHARE * max(0.0, problem.seconds_left)
    drawn = sorted(_sample_chains(problem, choices, until), key=lambda draw: _rough_seconds(problem, draw))
    usable = [positions for positions in drawn if not any(problem.world.collides(q) for q in positions[1:])]
    if not usable:
        return _explain_no_chain(problem, items, cancel)
    timed = [chain for positions in usable[:_MAX_TIMED] if (chain := _timed(problem, items, positions)) is not None]
    timed.sort(key=lambda chain: chain.seconds)
    found: list[JointChain] = []
    for chain in timed:
        if (checked := _checked(problem, chain)).free:
            found.append(checked)
        if len(found) >= _MAX_STARTS or cancel.reason(problem) or monotonic() > until:
            break
    better = [_optimised(problem, items, choices, chain, until) for chain in found]
    better = better or timed[:_MAX_STARTS]  # planners find a path where the straight edges are blocked
    return sorted(better, key=lambda chain: chain.seconds)


def fastest_goals_first(problem: Problem, goals: Sequence[Array]) -> list[Array]:
    """Return free goal positions (dof,) [rad], the fastest first; the best of them optimised for less time."""
    assert isinstance(problem.goal, Region | GoalChoice)
    items = [SequenceItem(problem.goal)]
    until = monotonic() + _TIME_SHARE * max(0.0, problem.seconds_left)
    timed = (_timed(problem, items, np.array([problem.start, goal])) for goal in goals)
    ranked = sorted((chain for chain in timed if chain is not None), key=lambda chain: chain.seconds)
    for chain in ranked[:_MAX_STARTS]:
        if (checked := _checked(problem, chain)).free:
            moved = _optimised(problem, items, [_choices(items[0])], checked, until)
            return [moved.positions[-1], *(chain.positions[-1] for chain in ranked)]
    return [chain.positions[-1] for chain in ranked]


def _choices(item: SequenceItem) -> Choices:
    assert not isinstance(item.goal, Arc)
    return item.goal.goals if isinstance(item.goal, GoalChoice) else (item.goal,)


def _sample_chains(problem: Problem, choices: Sequence[Choices], until: float) -> Iterator[Array]:
    """Yield chains (N + 1, dof): the last goal anywhere in its region, those before it near the line to it."""
    robot, rng, start = problem.robot, problem.rng, problem.start
    for attempt in range(_SAMPLES if any(len(some) > 1 or isinstance(some[0], Region) for some in choices) else 1):
        if monotonic() > until and attempt:
            return
        last = _sample_end(problem, choices[-1], attempt)
        if last is None:
            continue
        chain = [start]
        for number, between in enumerate(choices[:-1], 1):
            share = rng.uniform(0.0, 1.0) if len(choices) == 2 else number / len(choices)
            q = _project(robot, between, start + share * (last - start))
            if q is None:
                break
            chain.append(q)
        if len(chain) == len(choices):
            yield np.array([*chain, last])


def _sample_end(problem: Problem, ends: Choices, attempt: int) -> Array | None:
    """Return positions (dof,) [rad] at one of the last goals: near the start at first, then spread further."""
    robot, rng, start = problem.robot, problem.rng, problem.start
    end = ends[attempt % len(ends)]
    if not isinstance(end, Region):
        return end
    spread = (0.0, 0.5, 0.5, 1.5)[(attempt // len(ends)) % 4]
    seed = start if attempt < len(ends) else start + rng.normal(0.0, 1.0, robot.dof) * spread
    T = nearest_pose_in(end, robot.fk(start)) if attempt < len(ends) else sample_pose(end, rng)
    seed = np.clip(seed, robot.lower, robot.upper)
    if controls_full_pose(robot):
        return converge(robot, pin.SE3(T), seed, _ITERATIONS)
    there = transform(end.T_world_tcp[:3, :3], T[:3, 3])
    return solve_region_ik(robot, replace(end, T_world_tcp=there, half_sides=np.zeros(3)), seed)


def _project(robot: RobotModel, goals: Choices, q: Array) -> Array | None:
    """Return positions (dof,) [rad] near q at which the nearest of several goals is reached, or None."""
    T = robot.fk(q)

    def distance(goal: Array | Region) -> float:
        return distance_outside(goal, T) if isinstance(goal, Region) else float(np.abs(goal - q).max())

    goal = min(goals, key=distance)
    if not isinstance(goal, Region):
        return goal
    if distance_outside(goal, T) > 0.0 and not controls_full_pose(robot):
        return converge_to_region(robot, goal, q, _ITERATIONS)
    return q if distance_outside(goal, T) <= 0.0 else converge(robot, pin.SE3(nearest_pose_in(goal, T)), q, _ITERATIONS)


def _rough_seconds(problem: Problem, positions: Array) -> float:
    """Return about how long straight edges through positions (N, dof) take [s], without stops between."""
    edges = np.abs(np.diff(positions, axis=0))
    accelerating = math.sqrt(float((edges.sum(axis=0) / problem.acceleration).max()))
    return float((edges / problem.velocity).max(axis=1).sum()) + 2 * accelerating


def _timed(problem: Problem, items: Sequence[SequenceItem], positions: Array) -> JointChain | None:
    """Return a chain with its time, not yet checked for collisions; None if it cannot be timed."""
    if not (np.abs(np.diff(positions, axis=0)).max(axis=1) > _SAME).all():  # two positions are the same
        return JointChain(positions, np.zeros(len(positions)), _rough_seconds(problem, positions))
    cuts = _corner_cuts(problem.robot, items, positions)
    seconds = _seconds(problem, positions, cuts)
    return None if seconds is None else JointChain(positions, cuts, seconds)


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


def _checked(problem: Problem, chain: JointChain) -> JointChain:
    """Return the chain; where its edges are free, marked so and with corners rounded as far as they are free."""
    if not all(problem.world.edge_free(a, b) for a, b in pairwise(chain.positions)):
        return chain
    cuts, seconds = chain.cuts, chain.seconds
    while cuts.any() and not all(
        problem.world.blends_free(p, _BLEND_STEP) for p in blended_path(chain.positions, cuts)
    ):
        cuts = np.where(cuts > _LEAST_CUT, 0.5 * cuts, 0.0)
        seconds = _seconds(problem, chain.positions, cuts) or math.inf
    return replace(chain, cuts=cuts, seconds=seconds, free=True)


def _corner_cuts(robot: RobotModel, items: Sequence[SequenceItem], positions: Array) -> Array:
    """Return (N,) [rad] how much of the edges at each position may be rounded off within its item's blend radius."""
    cuts = np.zeros(len(positions))
    edges = np.diff(positions, axis=0)
    spans = np.linalg.norm(edges, axis=1)
    for i, item in enumerate(items[:-1], 1):
        if not item.blend_radius:
            continue
        cut = 0.5 * float(min(spans[i - 1], spans[i]))
        corner = robot.fk(positions[i])[:3, 3]
        for _ in range(8):
            ends = (positions[i] - cut / spans[i - 1] * edges[i - 1], positions[i] + cut / spans[i] * edges[i])
            away = max(float(np.linalg.norm(robot.fk(q)[:3, 3] - corner)) for q in ends)
            if away <= item.blend_radius:
                break
            cut *= _ROUNDED * item.blend_radius / away
        cuts[i] = cut
    return cuts


def _optimised(
    problem: Problem, items: Sequence[SequenceItem], choices: Sequence[Choices], chain: JointChain, until: float
) -> JointChain:
    """Return the chain after random moves that each made it quicker."""
    robot, rng, size, failures = problem.robot, problem.rng, _FIRST_MOVE, 0
    fixed = [all(isinstance(goal, np.ndarray) for goal in some) for some in choices]
    if all(fixed):
        return chain
    for _ in range(_MAX_MOVES):
        if monotonic() > until:
            break
        positions = chain.positions.copy()
        only = int(rng.integers(0, len(choices) + 1))  # one of them, or all
        for i, some in enumerate(choices, 1):
            if fixed[i - 1] or only not in (0, i):
                continue
            q = np.clip(positions[i] + rng.normal(0.0, size, robot.dof), robot.lower, robot.upper)
            projected = _project(robot, some, q)
            if projected is None:
                break
            positions[i] = projected
        else:
            quicker = _if_quicker(problem, items, positions, chain)
            if quicker is not None:
                chain, failures = quicker, 0
                continue
        failures += 1
        if failures >= _FAILURES_TO_SHRINK:
            size, failures = 0.5 * size, 0
            if size < _LEAST_MOVE:
                break
    return chain


def _if_quicker(
    problem: Problem, items: Sequence[SequenceItem], positions: Array, chain: JointChain
) -> JointChain | None:
    """Return the free chain through positions (N, dof) if it takes less time than another, else None."""
    if _rough_seconds(problem, positions) > _HOPELESS * _rough_seconds(problem, chain.positions):
        return None
    tried = _timed(problem, items, positions)
    if tried is None or tried.seconds >= chain.seconds or any(problem.world.collides(q) for q in positions[1:]):
        return None
    tried = _checked(problem, tried)
    return tried if tried.free and tried.seconds < chain.seconds else None


def _explain_no_chain(problem: Problem, items: Sequence[SequenceItem], cancel: Cancel) -> Result:
    """Return why the arm cannot reach the first item without free positions."""
    for number, item in enumerate(items, 1):
        samples = GoalSamples()
        for goal in _choices(item):
            samples = sample_goals(problem, goal, cancel, wanted=1, tries=20)
            if samples.goals:
                break
        if not samples.goals:
            failure = samples.failure(cancel.reason(problem))
            if not controls_full_pose(problem.robot):
                failure = _explained(problem, goal, failure)
            where = f"item {number} of {len(items)}: " if len(items) > 1 else ""
            return replace(failure, message=f"{where}{failure.message}", fraction=(number - 1) / len(items))
    return Result(error=cancel.reason(problem) or "no_ik", message="no joint positions lead through all items")
