"""The proof of a policy's chunks: how long it takes, and whether what it proves keeps its promises.

    python -m benchmarks.policy_proof [--chunks N] [--sequences N] [--seed S] [--solids N] [--json F]

Times: chunks of 50 rows on the Panda among 30 solids: `smooth` ones, `grazing` ones that pass close to solids,
`violating` ones of all hostile kinds; with `shorten` and `slow`. Wall time and processor time [ms].

Sequences: hostile chunks, each joined to the motion before at a random time, in random scenes, some with a held object,
with points that cameras saw, or with a region. The executed motions are sampled at 1 ms and judged by pinocchio and
coal: contacts, shares of the limits, the region. From random times of each motion, two kinds of stops that leave the
path are judged too. The complete motion passes the executor's checks. Ends with 1 if anything is wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in every process of a cell

import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import MotionState, ProvedMotion
from applications.policy.proof import ChunkProver, ProofOptions
from common.control.goals import Assessment
from common.control.trajectory import Tolerances, checked_trajectory
from common.errors import Refused
from common.messages import AttachedObject, Box, PlanningScene, Pose, Vector3
from common.planning.point_obstacles import PointObstacle
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import TimedPath, trajectory_message
from tests.applications.policy.hostile import KINDS, Attack, at_rest, attack, crowded, limits_of, solid, towards
from tests.applications.policy.judge import (
    STEP,
    Judge,
    braked_by_executor,
    braked_by_joints,
    positions_at,
    shares,
    state_at,
)
from tests.applications.policy.panda import READY, panda

Array = NDArray[np.float64]

ROWS, RATE = 50, 30.0
ROUNDING = 1e-4  # share of a limit
REGION_TOLERANCE = 1e-4  # [m]


def measure(chunks: int, seed: int, solids: int) -> dict[str, dict[str, float]]:
    """Return medians and 99th percentiles [ms] of each kind of chunk and each option."""
    robot, rng = panda(), np.random.default_rng(seed)
    scene = crowded(rng, solids)
    places = np.array([[o.pose.position.x, o.pose.position.y, o.pose.position.z] for o in scene.objects])
    prover = ChunkProver(robot, limits_of(robot))
    prover.set_scene(scene, READY)
    found: dict[str, dict[str, float]] = {}
    times = (np.arange(ROWS) + 0.5) / RATE
    for option in ("shorten", "slow"):
        prover.set_options(ProofOptions(option))  # type: ignore[arg-type]
        for kind in ("smooth", "grazing", "violating"):
            walls, cpus, results = [], [], Counter[str]()
            while len(walls) < chunks:
                state = at_rest()
                of = Attack(robot, state, times, places, rng)
                if kind == "smooth":
                    rows = towards(of, rng.normal(size=robot.dof) * 0.15)
                elif kind == "grazing":
                    rows = towards(of, rng.normal(size=robot.dof) * 0.5)
                else:
                    rows = KINDS[str(rng.choice(list(KINDS)))](of)
                wall, cpu = time.perf_counter(), time.process_time()
                proved = prover.prove(state, rows, times)
                wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
                cause = "" if proved.violation is None else proved.violation.cause
                if (kind == "smooth" and cause) or (kind == "grazing" and cause not in ("collision", "stop")):
                    continue
                walls.append(1e3 * wall)
                cpus.append(1e3 * cpu)
                results[cause or "complete"] += 1
            found[f"{kind}, {option}"] = {
                "median": float(np.median(walls)), "p99": float(np.percentile(walls, 99)),
                "median_cpu": float(np.median(cpus)), "p99_cpu": float(np.percentile(cpus, 99)), **results}
    return found


class Campaign:
    """Hostile sequences, and what was wrong with the motions that were proved for them."""

    def __init__(self, seed: int, solids: int) -> None:
        """Prepare one robot and prover for all sequences."""
        self.robot, self.seed, self.solids = panda(), seed, solids
        self.limits, self.geometry = limits_of(self.robot), RobotGeometry(self.robot)
        self.prover = ChunkProver(self.robot, self.limits)
        self.counts: Counter[str] = Counter()
        self.worst: dict[str, float] = {}
        self.least_share = 1.0
        self.seconds = 0.0
        self.faults: list[str] = []

    def run(self, number: int) -> None:
        """Run and judge one sequence."""
        rng = np.random.default_rng((self.seed, number))
        scene, spheres = crowded(rng, self.solids), None
        if rng.uniform() < 0.2:
            held = solid("held", "box", [0.04, 0.04, 0.12], np.array([0.0, 0.0, 0.05]), role="target")
            scene = PlanningScene(header=scene.header, objects=scene.objects,
                                  attached=[AttachedObject(object=held, link=self.robot.config.tcp_link)])
        if rng.uniform() < 0.2:
            at = rng.uniform((0.3, -0.5, 0.0), (0.8, 0.5, 0.6), (60, 3))
            spheres = np.column_stack([at, np.full(len(at), 0.01)])
        region = None
        if rng.uniform() < 0.3:
            at, side = self.robot.fk(READY)[:3, 3], rng.uniform(0.15, 0.6, 3)
            x, y, z = (float(value) for value in at + rng.uniform(-0.4, 0.4, 3) * side)
            region = Box(pose=Pose(position=Vector3(x=x, y=y, z=z)), size=Vector3(x=side[0], y=side[1], z=side[2]))
        choice = str(rng.choice(["shorten", "slow", "refuse"], p=[0.5, 0.4, 0.1]))
        self.prover.set_options(ProofOptions(choice, region))  # type: ignore[arg-type]
        judge = Judge(self.robot, self.geometry, scene, spheres)
        if judge.contacts(READY[None]):
            self.counts["start not free"] += 1
            scene = PlanningScene(header=scene.header, objects=scene.objects[:1])
            spheres, judge = None, Judge(self.robot, self.geometry, scene)
        seen = [] if spheres is None else [PointObstacle("camera", spheres)]
        self.prover.set_scene(scene, READY, seen)
        self._judge(number, judge, region, *self._attacked(rng, scene))

    def _attacked(self, rng: np.random.Generator, scene: PlanningScene) -> tuple[list[Array], list[MotionState]]:
        """Return the executed motion: sampled positions, and states at random times of it."""
        places = np.array([[o.pose.position.x, o.pose.position.y, o.pose.position.z] for o in scene.objects])
        state, running, begin = at_rest(), None, 0.0
        path, states, clock = [], [], 0.0
        for _ in range(int(rng.integers(2, 9))):
            kind, rows, times = attack(rng, state, places)
            proved = self.prover.prove(state, rows, times)
            cause = proved.violation.cause if proved.violation is not None else "complete"
            self.counts[cause] += 1
            self.counts["chunks"] += 1
            self.counts["rows"] += proved.rows
            self.counts["slowed"] += proved.slowed > 1
            self.counts[f"{kind}: executed"] += proved.rows > 0
            if len(proved.times):
                running, begin = proved, 0.0
            if running is None:
                continue
            end = float(running.times[-1])
            until = end if begin >= end else float(rng.uniform(begin, end))
            path.append((clock - begin, clock, running, until))
            clock += until - begin
            begin, state = until, state_at(running, until)
            states.append(state_at(running, float(rng.uniform(0.0, end))))
        if running is not None:
            path.append((clock - begin, clock, running, float(running.times[-1])))
            clock += float(running.times[-1]) - begin
        grid = np.arange(0.0, clock, STEP)
        parts = []
        for offset, since, motion, until in path:
            inside = grid[(grid >= since) & (grid < offset + until)]
            parts.append(positions_at(motion, inside - offset))
        self._check_executor(path)
        return parts, states

    def _check_executor(self, path: list[tuple[float, float, ProvedMotion, float]]) -> None:
        """Check the complete motion as the executor does."""
        times, states = [], []
        for offset, since, motion, until in path:
            inside = motion.times[(motion.times + offset > since + 1e-6) & (motion.times < until - 1e-6)]
            for t in ([] if times else [0.0]) + [*inside.tolist(), until]:
                if not times or t + offset > times[-1] + 1e-6:
                    times.append(t + offset)
                    states.append(state_at(motion, t))
        if len(times) < 2:
            return
        complete = TimedPath(np.array(times), *(np.array([getattr(s, field) for s in states]) for field in (
            "positions", "velocities", "accelerations")))
        try:
            checked = checked_trajectory(
                trajectory_message(self.robot, complete), self.limits, complete.positions[0], Tolerances())
            share = Assessment.of(checked, complete.positions[0], self.limits, 0.01).share
        except Refused as refusal:
            self.faults.append(f"refused by the executor: {refusal}")
            return
        self.least_share = min(self.least_share, share)

    def _judge(
        self, number: int, judge: Judge, region: Box | None, parts: list[Array], states: list[MotionState]
    ) -> None:
        path = np.concatenate([*parts, np.zeros((0, self.robot.dof))])
        self.counts["sequences"] += 1
        if len(path) < 4:
            return
        self.seconds += STEP * len(path)
        if touched := judge.contacts(path):
            self.counts["CONTACTS"] += 1
            self.faults.append(f"sequence {number}: {touched} ms of contact")
        for limit, share in shares(path, self.limits).items():
            self.worst[limit] = max(self.worst.get(limit, 0.0), share)
            if share > 1 + ROUNDING:
                self.faults.append(f"sequence {number}: {limit} at {share:.4f} of its limit")
        if region is not None:
            at, size = region.pose.position, region.size
            tool = judge.tool(path[::5], self.robot.tcp_frame)
            if judge.tool(path[:1], self.robot.tcp_frame).size:
                beyond = np.abs(tool - (at.x, at.y, at.z)) - np.array([size.x, size.y, size.z]) / 2
                if beyond.max() > REGION_TOLERANCE:
                    self.faults.append(f"sequence {number}: the TCP is {1e3 * beyond.max():.2f} mm outside its region")
        for state in states:
            self.counts["stops"] += 2
            self.counts["STOPS IN CONTACT, executor"] += judge.contacts(braked_by_executor(self.limits, state)) > 0
            self.counts["STOPS IN CONTACT, joints"] += judge.contacts(braked_by_joints(self.limits, state)) > 0


def main() -> int:
    """Measure, run the campaign, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=int, default=300, help="measured of each kind")
    parser.add_argument("--sequences", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first sequence")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--solids", type=int, default=30)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    figures = measure(options.chunks, options.seed, options.solids) if options.chunks else {}
    for kind, figure in figures.items():
        sys.stdout.write(f"{kind:20} " + "  ".join(
            f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in figure.items()) + "\n")
    campaign = Campaign(options.seed, options.solids)
    began = time.perf_counter()
    for number in range(options.first, options.first + options.sequences):
        campaign.run(number)
        if (number + 1) % 100 == 0:
            sys.stdout.write(f"sequence {number + 1} after {time.perf_counter() - began:.0f} s: "
                             f"{campaign.seconds:.0f} s of motion, {len(campaign.faults)} faults\n")
            sys.stdout.flush()
    summary = {"counts": dict(sorted(campaign.counts.items())), "largest shares of limits": campaign.worst,
               "least share of the executor": campaign.least_share, "seconds of motion": campaign.seconds,
               "faults": campaign.faults[:20]}
    sys.stdout.write(json.dumps(summary, indent=1) + "\n")
    if options.json is not None:
        options.json.write_text(json.dumps({"times": figures, **summary}, indent=1))
    stopped = sum(count for name, count in campaign.counts.items() if name.startswith("STOPS"))
    return int(bool(campaign.faults) or stopped > 0)


if __name__ == "__main__":
    sys.exit(main())
