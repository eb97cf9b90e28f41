"""Whether planning is as fast as before: kernel versus Python fallback, as ratios that do not depend on the machine.

    python -m benchmarks.ratios [--rounds N] [--write]

Each round asks the same of both, one after the other, and takes their processor time; the median of the rounds counts.
It is compared with benchmarks/ratios.json, and a ratio that has lost more than 20 % ends it with 1. --write stores what
was measured instead.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.planners import random_pairs, ur5_scene
from benchmarks.planning import table_with_balls
from common.config import load_cell
from common.messages import JointGoal, PlanningScene, PlanRequest
from common.planning import ik
from common.planning.collision import CollisionWorld
from common.planning.kernel.library import library, without_kernel
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel

Array = NDArray[np.float64]
Side = Callable[[], object]

STORED = Path(__file__).with_suffix(".json")
LOSS = 0.2  # of a ratio
LEAST = 0.05  # [s] of a measurement
SCENES: dict[str, Callable[[], PlanningScene]] = {"panda": table_with_balls, "ur5": ur5_scene}


def comparisons(cell: str) -> dict[str, tuple[Side, Side]]:
    """By name what the kernel does, and what is done without it."""
    config = load_cell(cell)
    robot, scene = RobotModel.load(config.robot), SCENES[cell]()
    pairs = random_pairs(robot, scene, 60)
    states = np.random.default_rng(1).uniform(robot.lower, robot.upper, (400, robot.dof))
    poses = [robot.fk(q) for q in states[:60]]

    def world() -> CollisionWorld:
        return CollisionWorld(robot, scene, start=robot.named("home"), padding=0.01)

    ours = world()
    with without_kernel():
        theirs = world()
    assert ours.kernel is not None and theirs.kernel is None
    blocked = [(a, b) for a, b in pairs if not ours.edge_free(a, b)]
    free = [(a, b) for a, b in pairs if ours.edge_free(a, b)][:8]
    pipeline = PlanningPipeline(robot, config.motion, config.pipeline)

    def plan(planner: str, a: Array, b: Array) -> bool:
        request = PlanRequest(
            id="1", start=a.tolist(), goal=JointGoal(positions=b.tolist()), planner=planner, planning_attempts=1,
            planning_time=1,
        )
        return pipeline.plan(request, scene).ok

    possible = [(a, b) for a, b in blocked if plan("rrt_connect", a, b)][:6]

    def without() -> object:
        with without_kernel():
            return [ik.solve_ik(robot, T, robot.named("home")) for T in poses]

    return {
        "states": tuple(lambda w=w: [w.collides(q) for q in states] for w in (ours, theirs)),
        "free edges": tuple(lambda w=w: [w.edge_free(a, b) for a, b in free] for w in (ours, theirs)),
        "blocked edges": tuple(lambda w=w: [w.edge_free(a, b) for a, b in blocked[:8]] for w in (ours, theirs)),
        "inverse kinematics": (lambda: [ik.solve_ik(robot, T, robot.named("home")) for T in poses], without),
        "ways around: rrt_connect, ompl": tuple(
            lambda p=p: [plan(p, a, b) for a, b in possible] for p in ("rrt_connect", "ompl")),
    }


def seconds(side: Side) -> float:
    """Processor time of one time, of as many as take long enough to be measured."""
    began, times, spent = time.process_time(), 0, 0.0
    while spent < LEAST:
        side()
        times, spent = times + 1, time.process_time() - began
    return spent / times


def measured(rounds: int) -> dict[str, float]:
    """How many times as long it takes without the kernel, the median of the rounds, by robot and name."""
    found = {}
    for cell in SCENES:
        for name, (ours, theirs) in comparisons(cell).items():
            ours(), theirs()
            ratios = [seconds(theirs) / seconds(ours) for _ in range(rounds)]
            found[f"{cell}: {name}"] = round(float(np.median(ratios)), 2)
    return found


def main() -> None:
    """Measure, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--write", action="store_true", help=f"store them in {STORED.name}")
    given = parser.parse_args()
    if library() is None:
        sys.exit("the planning kernel is not built: there is nothing to compare")
    found = measured(given.rounds)
    if given.write:
        STORED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    slower = []
    for name, ratio in found.items():
        before = stored.get(name)
        lost = before is not None and ratio < (1 - LOSS) * before
        slower += [name] if lost else []
        print(f"{name:45} {ratio:8.2f} times as long without it; stored {before}{'  SLOWER' if lost else ''}")
    if slower:
        sys.exit(f"lost more than {100 * LOSS:.0f} %: {', '.join(slower)}")


if __name__ == "__main__":
    main()
