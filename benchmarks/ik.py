"""Inverse kinematics: how fast random poses are solved, and how many are not.

    python -m benchmarks.ik [--robot panda|ur5 ...] [--count N] [--seed S] [--json F]

Poses are those of the TCP at random positions within the limits, seeds are random too. Every solution is checked by
pinocchio's forward kinematics; ends with 1 where one is wrong. Then some poses that are 5 % out of reach.
--json writes {robot: {median_ms, p95_ms, cpu_median_ms, cpu_p95_ms, not_found, wrong, out_of_reach_cpu_median_ms}}:
wall and processor time, and the share not found.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common.config import load_cell
from common.planning import ik
from common.robot.model import RobotModel
from common.robot.transforms import invert, transform

Array = NDArray[np.float64]


def wrong(robot: RobotModel, q: Array, T_world_tcp: Array) -> bool:
    """Whether q (dof,) [rad] is beyond a limit or does not put the TCP at a pose (4, 4), within the tolerances."""
    left = invert(robot.fk(q)) @ T_world_tcp
    near = np.linalg.norm(left[:3, 3]) <= 1.01 * ik.POSITION_TOLERANCE
    aligned = np.linalg.norm(pin.log3(left[:3, :3])) <= 1.01 * ik.ROTATION_TOLERANCE
    return not (near and aligned and robot.within_limits(q, 0.0))


def figures(robot: RobotModel, count: int, seed: int) -> dict[str, float]:
    """Times [ms] of so many poses within reach, the share not found, and the time of some out of reach."""
    rng = np.random.default_rng(seed)
    ends, seeds = rng.uniform(robot.lower, robot.upper, (2, count, robot.dof))
    poses = np.array([robot.fk(q) for q in ends])
    ik.solve_ik(robot, poses[0], seeds[0])
    wall, cpu, missing, faults = np.empty(count), np.empty(count), 0, 0
    for i in range(count):
        began, worked = time.perf_counter_ns(), time.thread_time_ns()
        q = ik.solve_ik(robot, poses[i], seeds[i], rng=rng)
        cpu[i], wall[i] = time.thread_time_ns() - worked, time.perf_counter_ns() - began
        missing += q is None
        faults += q is not None and wrong(robot, q, poses[i])
    lost = []
    for T, q in zip(poses[:50], seeds, strict=False):
        way = rng.normal(size=3)
        way *= 1.05 * robot.reach / np.linalg.norm(way)
        worked = time.thread_time_ns()
        faults += ik.solve_ik(robot, transform(T[:3, :3], robot.foot + way), q, rng=rng) is not None
        lost.append(time.thread_time_ns() - worked)
    (median, p95), (cpu_median, cpu_p95) = (1e-6 * np.percentile(times, [50, 95]) for times in (wall, cpu))
    return {
        "median_ms": float(median), "p95_ms": float(p95), "cpu_median_ms": float(cpu_median),
        "cpu_p95_ms": float(cpu_p95), "not_found": missing / count, "wrong": faults,
        "out_of_reach_cpu_median_ms": 1e-6 * float(np.median(lost)),
    }


def main() -> None:
    """Print the figures of each robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", action="append", choices=["panda", "ur5"])
    parser.add_argument("--count", type=int, default=1000, metavar="N", help="poses")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    found: dict[str, dict[str, float]] = {}
    for name in given.robot or ["panda", "ur5"]:
        s = found[name] = figures(RobotModel.load(load_cell(name).robot), given.count, given.seed)
        print(
            f"{name:6} wall median {s['median_ms']:.3f} p95 {s['p95_ms']:.3f} ms, CPU median {s['cpu_median_ms']:.3f} "
            f"p95 {s['cpu_p95_ms']:.3f} ms, {s['not_found']:.2%} not found, {s['wrong']:.0f} wrong; "
            f"out of reach {s['out_of_reach_cpu_median_ms']:.2f} ms",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    sys.exit(any(figure["wrong"] for figure in found.values()))


if __name__ == "__main__":
    main()
