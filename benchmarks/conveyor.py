"""Picks from a moving belt by images, in the complete cell on the virtual clock, kinematic or with physics.

    python -m benchmarks.conveyor --picks 50 --seed 1
    python -m benchmarks.conveyor --picks 50 --seed 1 --simulator mujoco

Each run has one cube at a random place and angle on a belt at a random speed of 0.05 to 0.2 m/s. A pick counts if the
cube is in the box at the end, by the ground truth, and the first attempt grasped it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from common import topics
from common.config import load_cell
from common.messages import GripperState, WorldObjects
from common.transport.bus import Bus
from common.transport.codec import decode
from common.transport.session import RawSample
from lab.simulation import Simulation

SIZE = 0.04  # [m] of a cube
LIMIT = 90.0  # [s] of a run


@dataclass
class Pick:
    """One run: belt speed [m/s], whether it was picked and at which attempt, and why not."""

    speed: float
    picked: bool
    attempts: int
    why: str


class Observer:
    """Reads the outcome of each grasp, and the last ground truth: for evaluation only."""

    def __init__(self) -> None:
        self.outcomes: dict[str, str] = {}
        self.truth = WorldObjects()

    def add(self, raw: RawSample, _now: float) -> None:
        """Take a message."""
        if raw.key.endswith(topics.GRIPPER_STATE.key):
            state = decode(GripperState, raw.payload)
            if state.outcome in ("grasped", "empty", "too_wide", "too_narrow"):
                self.outcomes.setdefault(state.id, state.outcome)
        elif raw.key.endswith(topics.SCENE_OBJECTS.key):
            self.truth = decode(WorldObjects, raw.payload)


def run(case: tuple[int, str]) -> Pick:
    """Run one pick."""
    seed, simulator = case
    rng = np.random.default_rng(seed)
    speed, across, yaw = rng.uniform(0.05, 0.2), rng.uniform(-0.03, 0.03), rng.uniform(-math.pi, math.pi)
    begin = 0.55 - 2.5 * speed + rng.uniform(-0.1, 0.1)  # [m] from the start of the belt
    cube = {"id": "cube", "shape": "box", "size": [SIZE] * 3, "x": 0.52 + across, "y": -0.95 + max(begin, 0.05),
            "z": 0.06, "yaw": yaw, "color": [0.9, 0.1, 0.1]}
    cell = load_cell("conveyor", [
        f"world.objects={json.dumps([cube])}", f"world.conveyors.belt.speed={speed}", f"world.simulator={simulator}",
        "services.belt_picker.settle=1.5", "services.depth_camera.rate=5"])
    observer = Observer()

    async def visit(_bus: Bus) -> None:
        return

    outcome = Simulation(cell, seed, limit=LIMIT, trace=observer, visit=visit).run()
    where = observer.truth.objects[0].container if observer.truth.objects else ""
    grasps = list(observer.outcomes.values())
    picked = where == "box" and grasps[:1] == ["grasped"]
    why = "" if picked else f"{outcome.state} {outcome.message} {grasps} cube in {where or 'no box'}"
    return Pick(speed, picked, len(grasps), why + "; ".join(outcome.broken[:1] + outcome.crashes[:1]))


def interval(good: int, of: int, z: float = 1.96) -> tuple[float, float]:
    """Return the Wilson interval of a share at 95 %."""
    p = good / of
    middle, half = p + z * z / (2 * of), z * math.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    return (middle - half) / (1 + z * z / of), (middle + half) / (1 + z * z / of)


def runs(seeds: range, simulator: str, jobs: int) -> Iterator[Pick]:
    """Yield the picks in order."""
    cases = [(seed, simulator) for seed in seeds]
    if jobs == 1:
        yield from map(run, cases)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(run, cases)


def main() -> int:
    """Print every failed pick, and the share with its interval."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picks", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1, help="first seed")
    parser.add_argument("--simulator", choices=["kinematic", "mujoco"], default="kinematic")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    began, good = time.monotonic(), 0
    seeds = range(options.seed, options.seed + options.picks)
    for seed, pick in zip(seeds, runs(seeds, options.simulator, options.jobs), strict=True):
        good += pick.picked
        what = "picked" if pick.picked else f"FAILED {pick.why}"
        print(f"seed {seed}: {pick.speed:.3f} m/s {what}", flush=True)
    low, high = interval(good, options.picks)
    print(f"{options.simulator}: {good} of {options.picks} picks at 0.05 to 0.2 m/s, seeds {seeds[0]} to {seeds[-1]} "
          f"({low:.0%} to {high:.0%} at 95 %), {time.monotonic() - began:.0f} s")
    wanted = {"kinematic": 0.96, "mujoco": 0.9}[options.simulator]
    return 0 if good >= wanted * options.picks else 1


if __name__ == "__main__":
    sys.exit(main())
