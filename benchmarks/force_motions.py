"""Force motions in the world with physics: contacts by `until`, and insertions of the peg, judged by the world's truth.

    python -m benchmarks.force_motions --contacts 100 --insertions 100 --json build/force_motions.jsonl

Each run has its own seed and world. Runs that are in the file are not repeated. Needs the extra `physics`.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.force_rig import GRASP, Rig
from benchmarks.grasping import share
from common.robot.transforms import rpy_to_matrix, tool_down

Array = NDArray[np.float64]

AXIS, TOP = np.array([0.50, 0.15]), 0.03  # [m] of the hole, and of the block
OFF, TILT = 1e-3, math.radians(1.0)
DEPTH, CLEARANCE = 0.015, 0.01  # [m] to insert, and above the block at the start
DEEP_ENOUGH = 0.0145  # [m] by the truth
STILL = 1e-3  # [m/s] of the TCP
PROMISED = 0.02  # [s] from the crossing of the force, after which the tool should not move


def contact(seed: int, speed: float | None = None) -> dict[str, Any]:
    """Touch the table with closed fingers, at a random place, speed (5 to 14 mm/s if not given) and force (3 to 15 N).

    The hand, 0.2 m wide, passes the peg.
    """
    rng, rig = np.random.default_rng(seed), Rig()
    rig.grip(0.0)
    rig.width = 0.0
    drawn, force = float(rng.uniform(0.005, 0.014)), float(rng.uniform(3.0, 15.0))
    speed = drawn if speed is None else speed
    rig.move(tool_down(rng.uniform(0.40, 0.62), rng.uniform(-0.02, 0.07), rng.uniform(0.03, 0.04)))
    rig.zero()
    steps: list[tuple[float, float, float]] = []
    offset = rig.now - rig.data.time  # between the clock of control and that of physics [s]
    rig.after_step = lambda now: steps.append((now + offset, rig.push_on("table", by_peg=False)[0], rig.tcp_height()))
    sent: list[tuple[float, Array]] = []
    rig.after_cycle = lambda: sent.append((rig.now, rig.executor.arm.set_point.copy()))
    status = rig.move_by_force(kind="until", force=force, speed=speed, max_distance=0.05)
    rig.wait(0.3)
    times, forces, heights = np.array(steps).T
    crossed = int(np.argmax(forces >= force))
    at = float(times[crossed])
    last = max(now for (now, q), (_, before) in zip(sent[1:], sent, strict=False) if not np.array_equal(q, before))
    fast = np.flatnonzero(np.abs(np.diff(heights)) / np.diff(times) > STILL)
    return {
        "kind": "contact", "seed": seed, "state": status.state, "message": status.message,
        "speed": round(speed, 5), "force": round(force, 2),
        "set_points_ms": round(1e3 * (last - at), 1), "standstill_ms": round(1e3 * float(times[fast[-1] + 1] - at), 1),
        "over_n": round(float(forces[crossed:].max()) - force, 2), "rest_n": round(float(forces[-1]), 2),
        "over_mm": round(1e3 * float(heights[crossed] - heights[crossed:].min()), 4),
        "late_mm": round(1e3 * float(np.ptp(heights[times > at + PROMISED])), 4)}


def insertion(seed: int) -> dict[str, Any]:
    """Insert the peg from OFF and TILT off, each in a random direction."""
    rng, rig = np.random.default_rng(seed), Rig()
    rig.pick()
    toward, about = rng.uniform(0.0, 2 * math.pi, 2)
    T = tool_down(*(AXIS + OFF * np.array([math.cos(toward), math.sin(toward)])), TOP + GRASP + CLEARANCE)
    tilt = rpy_to_matrix(TILT * math.cos(about), TILT * math.sin(about), 0.0)
    end = T[:3, 3] - [0.0, 0.0, GRASP]
    T[:3, 3] = end + tilt @ (T[:3, 3] - end)
    T[:3, :3] = tilt @ T[:3, :3]
    rig.move(T)
    rig.zero()
    began, pushes = rig.now, [(0.0, 0.0)]
    start = rig.foot()
    rig.after_cycle = lambda: pushes.append(rig.push_on("block", by_peg=True))
    status = rig.move_by_force(
        kind="insert", force=12.0, depth=DEPTH, tip=GRASP, surface=CLEARANCE, timeout=80.0,
        max_distance=CLEARANCE + DEPTH + 0.006)
    foot, push = rig.foot(), np.array(pushes)
    depth = TOP - float(foot[2])
    return {
        "kind": "insertion", "seed": seed, "state": status.state, "message": status.message,
        "inserted": status.state == "succeeded" and depth >= DEEP_ENOUGH, "depth_mm": round(1e3 * depth, 2),
        "start_off_mm": round(1e3 * float(np.linalg.norm(start[:2] - AXIS)), 2),
        "seconds": round(rig.now - began, 2), "most_n": round(float(push[:, 0].max()), 1),
        "penetration_mm": round(1e3 * float(push[:, 1].max()), 3),
        "usual_penetration_mm": round(1e3 * float(np.median(push[push[:, 0] > 0.0, 1])), 3)}


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print medians, largest values, and shares with their intervals."""
    for kind, good, values in (
        ("contact", lambda row: row["state"] == "succeeded" and row["over_n"] >= 0.0,
         ("set_points_ms", "standstill_ms", "late_mm", "over_n", "over_mm", "rest_n")),
        ("insertion", lambda row: row["inserted"],
         ("seconds", "depth_mm", "start_off_mm", "most_n", "penetration_mm", "usual_penetration_mm")),
    ):
        runs = [row for row in rows if row["kind"] == kind]
        if not runs:
            continue
        done = [row for row in runs if good(row)]
        print(f"{kind}: {share(len(done), len(runs))}")
        for value in values:
            found = np.array([row[value] for row in done])
            if len(found):
                print(f"  {value}: median {np.median(found):g}, {found.min():g} to {found.max():g}")
        for row in runs:
            if row not in done:
                print(f"  seed {row['seed']}: {row['message']}")


def main() -> None:
    """Run what is not in the file yet, and report all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contacts", type=int, default=20, metavar="COUNT")
    parser.add_argument("--insertions", type=int, default=20, metavar="COUNT")
    parser.add_argument("--speed", type=float, metavar="M_PER_S", help="of all contacts; a file is for one speed")
    parser.add_argument("--first", type=int, default=1, metavar="SEED")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    rows = [] if options.json is None or not options.json.exists() else [
        json.loads(line) for line in options.json.read_text(encoding="utf-8").splitlines()]
    known = {(row["kind"], row["seed"]) for row in rows}
    runs: list[tuple[str, Callable[[int], dict[str, Any]], int]] = [
        ("contact", partial(contact, speed=options.speed), options.contacts),
        ("insertion", insertion, options.insertions)]
    for kind, run, count in runs:
        for seed in range(options.first, options.first + count):
            if (kind, seed) in known:
                continue
            rows.append(row := run(seed))
            print(json.dumps(row), flush=True)
            if options.json is not None:
                with options.json.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    report(rows)


if __name__ == "__main__":
    main()
