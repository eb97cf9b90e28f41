"""A hostile policy in a complete cell with physics: contacts of the arm, counted by MuJoCo itself.

    python -m benchmarks.policy_physics [--sequences N] [--first N] [--seconds S] [--solids N]
                                        [--clearance M]

Each sequence is the cell `policy_panda` on the virtual clock, `world.simulator: mujoco`, with solids around the arm and
a policy whose chunks are hostile in all ways of tests/applications/policy/hostile.py. After each step of 2 ms MuJoCo's
contacts between a link and anything else are counted; MuJoCo finds no contact of links with each other. Invariants of
the simulated cell, such as limits of set-points, hold too. Ends with 1 if anything touched or broke.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from collections import Counter
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in every process of a cell

import mujoco
import numpy as np

from applications.policy.interface import Chunk, MotionState, Observation
from common.config import Cell, load_cell
from common.config.world import Fixture
from drivers.mujoco.scene import FIXED, OBJECT, ROBOT
from lab.simulation import Simulation
from tests.applications.policy.hostile import KINDS, Attack, crowded
from tests.applications.policy.panda import panda

CELL = "policy_panda"
CLOSEST = 0.2  # [m] between the origin of a solid and the axis of the base


class Hostile:
    """The policy of one sequence."""

    def __init__(self) -> None:
        """Start with the first sequence."""
        self.restart(0, np.zeros((1, 3)))

    def restart(self, seed: int, places: np.ndarray) -> None:
        """Begin a sequence among solids at places (N, 3) [m]."""
        self.rng, self.places, self.kinds = np.random.default_rng((seed, 9)), places, Counter[str]()
        self.kind, self.left = "", 0

    def chunk(self, observation: Observation) -> Chunk:
        """Return what continues the committed motion, and then is hostile."""
        rng, committed = self.rng, observation.committed
        rate = 20.0 if len(committed) else float(rng.choice([10.0, 20.0, 50.0]))
        position, velocity = observation.positions, observation.velocities
        if len(committed):
            position = committed[-1]
            velocity = (position - committed[-2]) * rate if len(committed) > 1 else velocity
        times = np.arange(1, int(rng.integers(5, 50)) + 1) / rate
        if not self.left:
            self.kind, self.left = str(rng.choice(list(KINDS))), int(rng.choice([1, 3, 6]))
        kind, self.left = self.kind, self.left - 1
        self.kinds[kind] += 1
        state = MotionState(position, velocity, 0.0 * position)
        rows = KINDS[kind](Attack(panda(), state, times, self.places, rng))
        if len(committed):
            rows = np.concatenate([committed, rows])
        width = np.full(len(rows), rng.choice([0.0, 0.08])) if rng.uniform() < 0.2 else None
        return Chunk(observation.stamp, rate, "joints", rows, width)


HOSTILE = Hostile()


def policy(observation: Observation) -> Chunk:
    """Be hostile."""
    return HOSTILE.chunk(observation)


class ContactCounter:
    """Replaces `mujoco.mj_step`, and counts steps after which a link touches something."""

    def __init__(self) -> None:
        """Count from 0."""
        self.steps, self.fixed, self.objects, self.travel = 0, 0, 0, 0.0
        self.pairs: Counter[str] = Counter()
        self._step = mujoco.mj_step

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, *more: Any) -> None:
        """Advance, and look at the contacts."""
        self._step(model, data, *more)
        self.steps += 1
        self.travel += float(np.abs(data.qvel).sum()) * model.opt.timestep  # of all joints together [rad]
        if not data.ncon:
            return
        found = set()
        for first, second in data.contact.geom[data.contact.dist <= 0.0]:
            kinds = int(model.geom_contype[first]) | int(model.geom_contype[second])
            if kinds & ROBOT and kinds & (FIXED | OBJECT):
                found.add(kinds & (FIXED | OBJECT))
                self.pairs[" - ".join(model.body(model.geom_bodyid[i]).name for i in (first, second))] += 1
        self.fixed += FIXED in found
        self.objects += OBJECT in found


def cell_of(seed: int, solids: int, seconds: float, clearance: float) -> tuple[Cell, np.ndarray]:
    """Return the cell of a sequence, and the places (N, 3) [m] of its solids."""
    rng = np.random.default_rng((seed, 8))
    choice = str(rng.choice(["slow", "shorten"]))
    cell = load_cell(CELL, [
        "world.simulator=mujoco", f"seed={seed}", "services.policy_runner.cameras={}",
        "services.policy_runner.source={callable: \"benchmarks.policy_physics:policy\"}",
        f"services.policy_runner.on_violation={choice}", f"services.policy_runner.seconds={seconds}",
        "services.policy_runner.until.height=9.0", f"services.policy_runner.clearance={clearance}"])
    found, home = list(cell.world.fixtures), panda().link_poses(panda().named("home"))
    for item in crowded(rng, 3 * solids).objects[1:]:
        at = np.array([item.pose.position.x, item.pose.position.y, item.pose.position.z])
        away = min(float(np.linalg.norm(T[:3, 3] - at)) for T in home.values())
        if away > CLOSEST and np.linalg.norm(at[:2]) > CLOSEST and len(found) <= solids:
            found.append(Fixture(id=item.id, shape=item.shape, dimensions=list(item.dimensions), position=at.tolist()))
    places = np.array([item.position for item in found[1:]])
    found.append(Fixture(id="ground", shape="box", dimensions=[3.0, 3.0, 0.02], position=[0.0, 0.0, -0.08]))
    world = cell.world.model_copy(update={"fixtures": found, "objects": []})
    services = {key: entry for key, entry in cell.services.items() if entry.name != "camera_simulator"}
    return cell.model_copy(update={"world": world, "services": services}), places


def main() -> int:
    """Run the sequences and print what they counted."""
    hostile: Hostile = importlib.import_module("benchmarks.policy_physics").HOSTILE  # as the cell imports it
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first sequence")
    parser.add_argument("--seconds", type=float, default=5.0, help="virtual time of each")
    parser.add_argument("--solids", type=int, default=12)
    parser.add_argument("--clearance", type=float, default=0.015, help="[m] more than servos leave their set-points")
    options = parser.parse_args()
    total, kinds, began, broken, ran = Counter[str](), Counter[str](), time.perf_counter(), [], 0
    for seed in range(options.first, options.first + options.sequences):
        cell, places = cell_of(seed, options.solids, options.seconds, options.clearance)
        hostile.restart(seed, places)
        counter = ContactCounter()
        with patch.object(mujoco, "mj_step", counter):
            outcome = Simulation(cell, seed, limit=options.seconds + 60.0).run()
        ran += 1
        kinds += hostile.kinds
        total.update(steps=counter.steps, radians=round(counter.travel), fixed=counter.fixed, objects=counter.objects,
                     chunks=sum(hostile.kinds.values()))
        if counter.fixed or outcome.broken or outcome.crashes:
            broken.append(seed)
            sys.stdout.write(f"sequence {seed}: {counter.fixed} steps in contact {dict(counter.pairs)}, "
                             f"{outcome.broken[:2]} {outcome.crashes[:1]}\n")
        sys.stdout.write(f"sequence {seed} after {time.perf_counter() - began:.0f} s: {outcome.state} "
                         f"{outcome.message}; {dict(total)}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{ran} sequences, {0.002 * total['steps']:.0f} s of physics, {total['chunks']} chunks "
                     f"{dict(kinds)}; steps in contact {total['fixed']}; sequences with a fault: {broken}\n")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
