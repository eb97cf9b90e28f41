"""Planning figures: IK, a straight line of 0.3 m, and random pairs on a table with seven balls and a box.

    python -m benchmarks.planning [PAIRS.npz] [--attempts N]

PAIRS.npz holds `starts` and `goals` (N, 7) [rad]. Times are wall time of the whole pipeline: checks, planning,
retiming, validation. Every trajectory is checked again at 0.01 rad, position by position.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.config import load_cell
from common.messages import (
    CollisionObject,
    Header,
    JointGoal,
    PlanningScene,
    PlanRequest,
    PlanResponse,
    Pose,
    PoseGoal,
    Vector3,
)
from common.planning.ik import solve_ik
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down

BALLS = [(0.30, -0.28), (0.35, -0.05), (0.42, -0.18), (0.48, 0.02), (0.55, -0.10), (0.60, -0.27), (0.33, 0.20)]
RECHECK_STEP = 0.01  # [rad]


def solid(name: str, role: str, shape: str, dimensions: list[float], x: float, y: float, z: float) -> CollisionObject:
    """An object of the scene at a point [m]."""
    pose = Pose(position=Vector3(x=x, y=y, z=z))
    return CollisionObject.model_validate(
        {"id": name, "role": role, "shape": shape, "dimensions": dimensions, "pose": pose}
    )


def table_with_balls() -> PlanningScene:
    """Table, open box of five panels and seven balls: the scene of the published figures."""
    objects = [
        solid("table", "fixture", "box", [1.2, 1.6, 0.05], 0.4, 0, -0.025),
        solid("box_floor", "container", "box", [0.2, 0.2, 0.005], 0.55, 0.25, 0.0025),
    ]
    for i, (dx, dy) in enumerate([(0.0975, 0), (-0.0975, 0), (0, 0.0975), (0, -0.0975)]):
        sides = [0.005, 0.2, 0.12] if dx else [0.2, 0.005, 0.12]
        objects.append(solid(f"box_wall_{i}", "container", "box", sides, 0.55 + dx, 0.25 + dy, 0.06))
    objects += [solid(f"ball_{i}", "target", "sphere", [0.03], x, y, 0.03) for i, (x, y) in enumerate(BALLS)]
    return PlanningScene(header=Header(frame_id="world"), objects=objects)


def report(name: str, seconds: list[float], more: str = "") -> None:
    """Print median, 95th percentile and maximum [ms]."""
    median, p95, most = np.percentile(np.array(seconds) * 1e3, [50, 95, 100])
    print(f"{name:44} median {median:7.2f}  p95 {p95:7.2f}  max {most:7.2f} ms  {more}")


def timed_plan(
    pipeline: PlanningPipeline, request: PlanRequest, scene: PlanningScene, seconds: list[float]
) -> PlanResponse:
    """The response; its wall time is appended to `seconds`."""
    began = time.perf_counter()
    response = pipeline.plan(request, scene)
    seconds.append(time.perf_counter() - began)
    return response


def collides_again(
    pipeline: PlanningPipeline, request: PlanRequest, scene: PlanningScene, response: PlanResponse
) -> bool:
    """Whether any position of the trajectory, 0.01 rad apart, collides in a collision world of its own."""
    assert response.trajectory is not None
    path, _ = fine_samples(timed_path(response.trajectory), RECHECK_STEP)
    world = pipeline.world(request, scene, request.start)
    return any(world.collides(q) for q in path)


def ik_figures(robot: RobotModel) -> None:
    """IK over the table from home; `benchmarks.ik` has that of random poses."""
    rng = np.random.default_rng(0)
    seconds, found = [], 0
    for _ in range(300):
        radius, angle = rng.uniform(0.3, 0.7), rng.uniform(-0.9, 0.9)
        T = tool_down(radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.03, 0.25), rng.uniform(-1.5, 1.5))
        began = time.perf_counter()
        found += solve_ik(robot, T, robot.named("home")) is not None
        seconds.append(time.perf_counter() - began)
    report("IK, tool down over the table, from home", seconds, f"{found} of 300 found")


def line_figures(pipeline: PlanningPipeline, robot: RobotModel, scene: PlanningScene) -> None:
    """A straight line of 0.3 m above the balls at 1 cm: on an unchanged scene, and with balls that move each time."""
    start = solve_ik(robot, tool_down(0.45, -0.15, 0.2), robot.named("home"))
    assert start is not None
    goal = PoseGoal(pose=matrix_to_pose(tool_down(0.45, 0.15, 0.2)))
    request = PlanRequest(id="line", start=start.tolist(), goal=goal, straight=True)
    rng = np.random.default_rng(0)
    for name, noise in (("line of 0.3 m, same scene", 0.0), ("line of 0.3 m, balls move between plans", 0.002)):
        seconds: list[float] = []
        ok = 0
        for _ in range(100):
            seen = scene.model_copy(deep=True)
            for item in seen.objects:
                if item.role == "target":
                    item.pose.position.x += rng.normal(0, noise) if noise else 0.0
            ok += timed_plan(pipeline, request, seen, seconds).ok
        report(name, seconds, f"{ok} of 100 planned")


def pair_figures(
    pipeline: PlanningPipeline, scene: PlanningScene, pairs: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    attempts: int | None,
) -> None:
    """Joint goals through the whole pipeline; pairs whose straight edge is blocked also by themselves."""
    seconds: list[float] = []
    blocked: list[float] = []
    found = collisions = 0
    for i, (start, goal) in enumerate(pairs):
        request = PlanRequest(
            id="pair", start=start.tolist(), goal=JointGoal(positions=goal.tolist()), planning_attempts=attempts, seed=i
        )
        response = timed_plan(pipeline, request, scene, seconds)
        if response.planner != "joint_move":
            blocked.append(seconds[-1])
        if response.ok:
            found += 1
            collisions += collides_again(pipeline, request, scene, response)
        else:
            print(f"  pair {i}: {response.message}")
    label = f"attempts {attempts or 'as configured'}"
    outcome = f"{found} of {len(pairs)} found, {collisions} in collision when checked again"
    report(f"pairs, {label}", seconds, outcome)
    if blocked:
        report(f"  of these blocked, {label}", blocked, f"{len(blocked)} pairs")


def main() -> None:
    """Run all figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="?", type=Path, help="npz file with starts and goals (N, 7)")
    parser.add_argument("--attempts", type=int, help="planning attempts of the pairs; else 1 and the configured")
    given = parser.parse_args()
    cell = load_cell("panda")
    robot = RobotModel.load(cell.robot)
    scene = table_with_balls()
    began = time.perf_counter()
    pipeline = PlanningPipeline(robot, cell.motion, cell.pipeline)
    print(f"{'pipeline loaded':44} {1e3 * (time.perf_counter() - began):14.1f} ms")
    ik_figures(robot)
    line_figures(pipeline, robot, scene)
    if given.pairs is None or not given.pairs.is_file():
        print(f"pairs skipped: {given.pairs or 'no file'} is not there; give an npz file with starts and goals")
        return
    arrays = np.load(given.pairs)
    pairs = list(zip(arrays["starts"], arrays["goals"], strict=True))
    for attempts in [given.attempts] if given.attempts else [1, None]:
        pair_figures(pipeline, scene, pairs, attempts)


if __name__ == "__main__":
    main()
