"""Ten plan requests at once against ten one after the other, through a planner's own process and the network.

    python -m benchmarks.at_once [--cell panda] [--rounds N] [--boxes N]

The requests are those of 60 random pairs of positions that take longest to plan in the cell's own scene, each from a
start and to a goal of its own; with `--boxes`, among so many boxes that float about the arm. Both ways take turns;
printed are medians of wall time and of the ratio of neighbours. The last line is what the machine has to give: the same
ratio of two processes that do nothing but compute, side by side against one after the other.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import time
from statistics import median

import numpy as np

from common.config import Fixture, load_cell
from common.messages import Header, JointGoal, PlanningScene, PlanRequest, PlanResponse
from common.planning.collision import CollisionWorld
from common.robot.model import RobotModel
from common.scene.fixtures import fixture_objects
from common.topics import MOTION_PLAN
from zencell import Cell

PAIRS, COUNT, TIMEOUT = 60, 10, 60.0
BUDGET = 1.0  # [s] for one plan: of pairs that take longer, or have no way, others are taken in place


def crowded(name: str, boxes: int) -> str:
    """An override that adds boxes of 0.1 m to the cell's fixtures, 0.35 to 0.8 m from the arm's foot and above it.

    None is where the arm is at home: a cell in which that is so does not start.
    """
    cell, rng = load_cell(name), np.random.default_rng(1)
    robot = RobotModel.load(cell.robot)
    home = robot.named("home")
    fixtures = [fixture.model_dump(mode="json", exclude_defaults=True) for fixture in cell.world.fixtures]
    for number in range(boxes):
        turn, away, up = rng.uniform((-np.pi, 0.35, 0.2), (np.pi, 0.8, 1.0))
        place = [round(float(value), 3) for value in (away * np.cos(turn), away * np.sin(turn), up)]
        box = Fixture(id=f"floating_{number}", dimensions=(0.1, 0.1, 0.1), position=tuple(place))
        boxed = fixture_objects(cell.world.model_copy(update={"fixtures": [box]}))
        alone = PlanningScene(header=Header(stamp=0, frame_id="world"), objects=boxed)
        if CollisionWorld(robot, alone, start=home).colliding_pair(home) is None:
            fixtures.append(box.model_dump(mode="json", exclude_defaults=True))
    return f"world.fixtures={json.dumps(fixtures)}"


async def measure(name: str, rounds: int, boxes: int) -> None:
    """Measure, and print a line for each way."""
    robot = RobotModel.load(load_cell(name).robot)
    rng = np.random.default_rng(0)
    overrides = ["autostart=false", *([crowded(name, boxes)] if boxes else [])]
    async with Cell.start(name, overrides=overrides) as cell:

        async def plan(request: PlanRequest) -> PlanResponse | None:
            try:
                return await cell.call(MOTION_PLAN.key, request, timeout=TIMEOUT)
            except Exception:  # noqa: BLE001 - one that touches something at its start or goal is another's business
                return None

        timed = []
        for number in range(20 * PAIRS):
            start, goal = rng.uniform(robot.lower, robot.upper), rng.uniform(robot.lower, robot.upper)
            request = PlanRequest(id=f"pair-{number}", start=start.tolist(), goal=JointGoal(positions=goal.tolist()),
                                  planning_time=BUDGET)
            began = time.perf_counter()
            answer = await plan(request)
            if answer is not None and answer.ok:
                timed.append((time.perf_counter() - began, request))
            if len(timed) == PAIRS:
                break
        hardest = [request for _, request in sorted(timed, key=lambda pair: -pair[0])[:COUNT]]
        rows: list[tuple[float, float]] = []
        for _ in range(rounds + 1):
            began = time.perf_counter()
            for request in hardest:
                await plan(request)
            between = time.perf_counter()
            await asyncio.gather(*map(plan, hardest))
            rows.append((between - began, time.perf_counter() - between))
        rows.pop(0)  # a helper loads the robot when it is asked for the first time
        print(f"{name}, {boxes} boxes: {COUNT} of {PAIRS}: one after the other "
              f"{1e3 * median(one for one, _ in rows):.1f} ms, at once {1e3 * median(two for _, two in rows):.1f} ms, "
              f"ratio {median(two / one for one, two in rows):.2f} ({rounds} rounds)")


def compute(_: int) -> int:
    """Something that takes a processor for some 50 ms."""
    return sum(number * number % 7 for number in range(500_000))


def possible(rounds: int) -> float:
    """The median ratio of two at once to two in a row."""
    ratios = []
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        for _ in range(rounds + 1):
            began = time.perf_counter()
            for each in range(2):
                pool.apply(compute, (each,))
            between = time.perf_counter()
            pool.map(compute, range(2), chunksize=1)
            ratios.append((time.perf_counter() - between) / (between - began))
    return median(ratios[1:])


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell", default="panda")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--boxes", type=int, default=0)
    options = parser.parse_args()
    asyncio.run(measure(options.cell, options.rounds, options.boxes))
    print(f"two processes that only compute: ratio {possible(options.rounds):.2f}")


if __name__ == "__main__":
    main()
