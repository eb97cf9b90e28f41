"""Two Pandas that face each other over one table cross in its middle: contacts, makespan, time of proofs.

`tasks`: each arm picks and places at random in the shared middle and returns home, with real trajectory controllers and
the coordinator on a virtual clock. An independent judge (pinocchio and coal, nothing of the proof) measures the
distance of the arms along the recorded set-points of both at the same time, every 0.005 rad. The same tasks in turns,
one motion at a time, are the comparison. With `--simulator mujoco` servos move the arms in a world with physics: the
judge measures along the positions that the arms reach, and the contacts that MuJoCo computes between geoms of different
arms in each step of 2 ms are counted. `cell`: a whole cell, with cameras, planners and tasks, on the virtual clock.
`proofs`: time to prove motions of 5 s.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.arms import arms_topic
from common.config import World, load_cell
from common.planning.arms.arm import Options
from common.planning.arms.pair_world import PairWorld
from common.planning.arms.timed_pairs import ArmMotion, PairProof, Schedule
from common.planning.arms.way_back import straight
from common.planning.ik import solve_ik
from common.planning.trajectory import TimedPath, join
from common.robot.model import RobotModel
from common.sim.interface import KINEMATIC
from common.transport.bus import Bus
from lab.simulation import Simulation
from tests.two_arms import TwoArms, judged

Array = NDArray[np.float64]

MIDDLE = ([0.4, -0.3, 0.06], [0.7, 0.3, 0.25])  # [m] of the TCP from the base of each arm: both reach it
ABOVE = 0.15  # [m] of the pose before a pick or place
SPEED = 0.4  # share of the joint limits
LONGEST = 180.0  # [s] cell time of a task
CELL = Path(__file__).parents[1] / "tests" / "data" / "two_arms.yaml"
BALLS = [[x, side * y] for side in (1, -1) for x, y in ((0.4, 0.25), (0.5, 0.35), (0.38, 0.45), (0.48, 0.5))]


@dataclass
class Outcome:
    """Of one task."""

    seed: int
    makespan: float = 0.0
    distance: float = np.inf
    judged: int = 0
    refused: int = 0
    replaced: int = 0  # places that an arm at home blocks
    retreats: int = 0
    unfinished: int = 0
    gap: float = 0.0
    contacts: int = 0  # steps of physics with a contact between the arms
    error: float = 0.0  # largest tracking error [rad]


def place(robot: RobotModel, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return joint positions (dof,) [rad] above a random place of the middle, and at it, with the tool down."""
    home = robot.named("home")
    while True:
        T = robot.fk(home)
        turn = rng.uniform(-0.8, 0.8)
        T[:3, :3] = T[:3, :3] @ np.array(
            [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        T[:3, 3] = robot.foot * [1, 1, 0] + (robot.config.base_rpy[2] == 0.0 or -1.0) * rng.uniform(*MIDDLE)
        T[2, 3] = abs(T[2, 3])
        at = solve_ik(robot, T, home, restarts=0)
        T[2, 3] += ABOVE
        above = None if at is None else solve_ik(robot, T, at, restarts=0)
        if at is not None and above is not None and np.abs(above - at).max() < 1.5:
            return above, at


def task(seed: int, turns: bool, judge: bool, simulator: str = KINEMATIC) -> Outcome:
    """Let both arms pick and place.

    A motion that is refused for a retreat is requested again from where the arm is; a place that the other arm blocks
    even at home is replaced by another one.
    """
    rng = np.random.default_rng(seed)
    sim = TwoArms(Options(turns=turns), seed=seed, world=None if simulator == KINEMATIC else World(simulator=simulator))
    outcome, stages, pauses = Outcome(seed), dict[str, list[list[Array]]](), dict[str, float]()
    for name, robot in sim.robots.items():
        places = [place(robot, rng) for _ in range(2)]
        stages[name] = [[q for above, at in [one] for q in (above, at)] for one in places] + [[robot.named("home")]]
        pauses[name] = float(rng.uniform(0.0, 0.5))
    goals, number, last = dict.fromkeys(stages, ""), 0, dict[str, Array]()

    def each() -> None:
        nonlocal number
        outcome.error = max(outcome.error, *(float(np.abs(arm.q - arm.measured).max()) for arm in sim.arms.values()))
        for name, arm in sim.arms.items():
            result = sim.results.get(goals[name])
            if result is not None and result.state:
                if result.state == "succeeded":
                    last[name] = stages[name][0][0]
                    stages[name].pop(0)
                    pauses[name] = sim.now + 0.5  # the fingers move
                elif result.error == "blocked" and len(stages[name]) > 1:
                    outcome.replaced += 1
                    stages[name][0] = [*place(arm.robot, rng)]
                    pauses[name] = sim.now + 0.3
                else:
                    outcome.refused += result.error not in ("retreats", "busy")
                    pauses[name] = sim.now + 0.3
                goals[name] = ""
            if not goals[name] and stages[name] and sim.now >= pauses[name] and not arm.controller.goal and (
                    arm.controller.at_rest) and outcome.refused < 20:
                number += 1
                goals[name] = f"{name}-{number}"
                way = [*([last[name]] if name in last and _close(arm.q, last, name, sim) else []), *stages[name][0]]
                sim.execute(name, goals[name], _through(sim, name, way))

    while any(stages.values()) and sim.now < LONGEST and outcome.refused < 20:
        sim.run(0.5, each)
    outcome.unfinished = sum(map(len, stages.values()))
    outcome.makespan = max(result.over for goal, result in sim.results.items() if not goal.startswith("retreat"))
    outcome.retreats = sum(goal.startswith("retreat") for goal in sim.results)
    outcome.gap, outcome.contacts = sim.largest_gap, sim.contacts
    if judge:
        distances = sim.judged(0.005)
        outcome.distance, outcome.judged = min(distances), len(distances)
    return outcome


def _close(q: Array, last: dict[str, Array], name: str, sim: TwoArms) -> bool:
    """Return whether the arm is at a place, above which it begins its way."""
    return bool(np.abs(q - sim.robots[name].named("home")).max() > 0.05 and np.abs(q - last[name]).max() < 1.5)


def _through(sim: TwoArms, name: str, way: list[Array]) -> TimedPath:
    q, parts = sim.arms[name].q, []
    for point in way:
        parts.append(straight(q, point, sim.coordinator.arms[name].limits, SPEED))
        q = point
    return join(parts)


def proofs(count: int, seed: int) -> dict[str, float]:
    """Return times [ms] to prove motions of 5 s between random places, for the first time."""
    sim, rng, times = TwoArms(), np.random.default_rng(seed), []
    left, right = (sim.coordinator.arms[name] for name in ("left", "right"))
    world, free = PairWorld(left.body, right.body), 0
    for _ in range(count):
        motions = []
        for arm in (left, right):
            path = straight(place(arm.geometry.robot, rng)[0], place(arm.geometry.robot, rng)[1], arm.limits)
            scale = 5.0 / path.duration
            motions.append(ArmMotion(TimedPath(
                path.times * scale, path.positions, path.velocities / scale, path.accelerations / scale**2)))
        begin = time.perf_counter()
        free += PairProof(world, motions[0], motions[1], 0.02).in_time(Schedule(0.0), Schedule(0.5), 0.35) is None
        times.append(1e3 * (time.perf_counter() - begin))
    return {"free": free, **{f"p{p}_ms": round(float(np.percentile(times, p)), 1) for p in (50, 95, 100)}}


def cell(seed: int, turns: bool) -> dict[str, object]:
    """Clear a table with balls on both sides; return the makespan [s cell time]."""
    rng = np.random.default_rng(seed)
    balls = [[round(x + rng.uniform(-0.02, 0.02), 3), round(y + rng.uniform(-0.02, 0.02), 3)] for x, y in BALLS]
    options = [f"services.arm_coordinator.turns={'true' if turns else 'false'}", f"world.balls={json.dumps(balls)}"]
    found = load_cell(str(CELL), options)
    states: dict[str, list[Array]] = {arm: [] for arm in found.robots}

    async def visit(bus: Bus) -> None:
        readers = {arm: bus.reader(arms_topic(topics.JOINT_STATES, arm)) for arm in found.robots}
        first = next(iter(readers.values()))
        while True:
            await first.next()
            for arm, reader in readers.items():
                if reader.latest is not None:
                    states[arm].append(np.array(reader.latest.position[:7]))

    outcome = Simulation(found, seed, limit=400.0).run()
    figures: dict[str, object] = {"state": outcome.state, "done": outcome.done, "total": outcome.total,
                                  "seconds": round(outcome.seconds, 2), "crashes": len(outcome.crashes)}
    if not turns:
        Simulation(found, seed, visit=visit, limit=400.0).run()  # the same run; with a visitor it has no duration
        robots = [RobotModel.load(robot) for robot in found.robots.values()]
        distances = judged(robots[0], robots[1], list(zip(*states.values(), strict=False)), 0.005)
        figures |= {"distance": round(min(distances), 3), "judged": len(distances)}  # inf: more than 0.1 m
    return figures


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["tasks", "cell", "proofs"], nargs="?", default="tasks")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--simulator", choices=[KINEMATIC, "mujoco"], default=KINEMATIC, help="of `tasks`")
    given = parser.parse_args()
    if given.what == "proofs":
        print(proofs(given.count, given.seed))
        return
    if given.what == "cell":
        for seed in range(given.seed, given.seed + given.count):
            for turns in (False, True):
                print(seed, "in turns" if turns else "at once ", cell(seed, turns), flush=True)
        return
    seeds = range(given.seed, given.seed + given.count)
    with ProcessPoolExecutor(given.jobs) as pool:
        at_once = []
        for one in pool.map(partial(task, turns=False, judge=True, simulator=given.simulator), seeds):
            at_once.append(one)
            print(one, flush=True)
        in_turns = []
        if given.simulator == KINEMATIC:
            print("in turns", flush=True)
            in_turns = list(pool.map(partial(task, turns=True, judge=False), seeds))
    print(f"tasks {len(at_once)}, seeds {seeds.start} to {seeds.stop - 1}; "
          f"contacts {sum(one.distance <= 0 for one in at_once)} in {sum(one.judged for one in at_once)} states; "
          f"least distance {min(one.distance for one in at_once):.4f} m")
    print(f"unfinished {sum(one.unfinished > 0 for one in at_once)}, refused {sum(one.refused for one in at_once)}, "
          f"places replaced {sum(one.replaced for one in at_once)}, "
          f"retreats {sum(one.retreats for one in at_once)}, largest gap of schedules "
          f"{max(one.gap for one in at_once):.3f} s")
    if not in_turns:
        print(f"steps of physics with a contact between the arms: {sum(one.contacts for one in at_once)}; "
              f"largest tracking error {max(one.error for one in at_once):.4f} rad")
        return
    ratios = [b.makespan / a.makespan for a, b in zip(at_once, in_turns, strict=True)
              if not a.unfinished | b.unfinished]
    print(f"makespan in turns / at once: mean {np.mean(ratios):.2f}, 5 to 95 % "
          f"{np.percentile(ratios, 5):.2f} to {np.percentile(ratios, 95):.2f}; "
          f"sum {sum(b.makespan for b in in_turns) / sum(a.makespan for a in at_once):.2f}")


if __name__ == "__main__":
    main()
