"""All planners on the same problems: joint goals for the Panda and for the UR5, or the poses that belong to them.

    python -m benchmarks.planners [PANDA_PAIRS.npz] [--count N] [--robot panda|ur5] [--planner NAME] [--cpu]

PANDA_PAIRS.npz holds `starts` and `goals` (N, 7) [rad]; without it, and for the UR5, pairs of random free positions
are made. Planners of joint goals get the goal, those of tool motions its pose: `cartesian` and `lin` go there in a
straight line and `circ` on an arc over a point above the middle. Times are those of the whole pipeline (checks,
planning, retiming, validation), of the problems that were solved and of all. Trajectories are checked again at
0.01 rad, position by position. Prints the tables of docs/planners.md.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.planning import collides_again, solid, table_with_balls
from common.config import Pipeline, load_cell
from common.messages import (
    ArcGoal,
    Header,
    JointGoal,
    PlanningScene,
    PlanRequest,
    PlanResponse,
    PoseGoal,
    SequenceGoal,
    SequenceItem,
    Vector3,
)
from common.planning.collision import CollisionWorld
from common.planning.pipeline import PlanningPipeline
from common.planning.trajectory import timed_path
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from common.scene.fixtures import fixture_objects

Array = NDArray[np.float64]

PLANNERS = ("joint_move", "lerp", "ptp", "ompl", "chomp", "trajopt", "cartesian", "lin", "circ", "sequence")
ARC_HEIGHT = 0.1  # [m] of the point on the way above the middle


@dataclass
class Figures:
    """What one planner did on all problems."""

    solved: list[float] = field(default_factory=list)  # [s]
    every: list[float] = field(default_factory=list)  # [s]
    joint_way: list[float] = field(default_factory=list)  # [rad]
    tool_way: list[float] = field(default_factory=list)  # [m]
    seconds: list[float] = field(default_factory=list)  # duration of the motion [s]
    colliding: int = 0
    errors: dict[str, int] = field(default_factory=dict)


def ur5_scene() -> PlanningScene:
    """Robot base, target base and ground, and four objects that stand on the target base."""
    cell = load_cell("ur5")
    objects = [
        *fixture_objects(cell.world),
        solid("ground", "fixture", "box", [4.0, 4.0, 0.05], 0.0, 0.0, -0.025),
        solid("cube", "target", "box", [0.1, 0.1, 0.1], 0.5, 0.0, 1.05),
        solid("post", "target", "cylinder", [0.04, 0.25], 0.45, -0.25, 1.125),
        solid("can", "target", "cylinder", [0.05, 0.12], 0.55, 0.25, 1.06),
        solid("shelf", "fixture", "box", [0.2, 0.3, 0.02], 0.45, 0.45, 1.4),
    ]
    return PlanningScene(header=Header(frame_id="world"), objects=objects)


def random_pairs(robot: RobotModel, scene: PlanningScene, count: int) -> list[tuple[Array, Array]]:
    """Pairs of free positions, uniform within the limits; the same ones each time."""
    rng = np.random.default_rng(0)
    world = CollisionWorld(robot, scene, start=robot.named("home"), padding=0.01)
    free: list[Array] = []
    while len(free) < 2 * count:
        q = rng.uniform(robot.lower, robot.upper)
        if not world.collides(q):
            free.append(q)
    return list(zip(free[::2], free[1::2], strict=True))


def request_for(planner: str, robot: RobotModel, number: int, start: Array, goal: Array, attempts: int) -> PlanRequest:
    """The request that suits a planner: joint positions, their pose, an arc, or lines over a point."""
    T_start, T_goal = robot.fk(start), robot.fk(goal)
    middle = 0.5 * (T_start[:3, 3] + T_goal[:3, 3]) + (0, 0, ARC_HEIGHT)
    pose = matrix_to_pose(T_goal)
    wanted: JointGoal | PoseGoal | ArcGoal | SequenceGoal = JointGoal(positions=goal.tolist())
    if planner in ("cartesian", "lin"):
        wanted = PoseGoal(pose=pose)
    elif planner == "circ":
        wanted = ArcGoal(pose=pose, via=Vector3(x=middle[0], y=middle[1], z=middle[2]))
    elif planner == "sequence":
        via = T_start.copy()
        via[:3, 3] = middle
        items = [
            SequenceItem(goal=PoseGoal(pose=matrix_to_pose(via)), straight=True, blend_radius=0.04),
            SequenceItem(goal=JointGoal(positions=goal.tolist())),
        ]
        wanted = SequenceGoal(items=items)
    return PlanRequest(id="pair", start=start.tolist(), goal=wanted, seed=number, planning_attempts=attempts)


def figures(
    planner: str,
    pipeline: PlanningPipeline,
    scene: PlanningScene,
    pairs: list[tuple[Array, Array]],
    attempts: int,
    cpu: bool,
) -> Figures:
    """What a planner does on all pairs."""
    clock = time.process_time if cpu else time.perf_counter
    robot, result = pipeline.robot, Figures()
    for number, (start, goal) in enumerate(pairs):
        request = request_for(planner, robot, number, start, goal, attempts)
        began = clock()
        response = pipeline.plan(request, scene)
        result.every.append(clock() - began)
        if not response.ok:
            result.errors[response.error] = result.errors.get(response.error, 0) + 1
            continue
        result.solved.append(result.every[-1])
        result.colliding += collides_again(pipeline, request, scene, response)
        _measure(robot, response, result)
    return result


def _measure(robot: RobotModel, response: PlanResponse, result: Figures) -> None:
    assert response.trajectory is not None
    path = timed_path(response.trajectory)
    tool = np.array([robot.fk(q)[:3, 3] for q in path.positions])
    result.joint_way.append(float(np.linalg.norm(np.diff(path.positions, axis=0), axis=1).sum()))
    result.tool_way.append(float(np.linalg.norm(np.diff(tool, axis=0), axis=1).sum()))
    result.seconds.append(path.duration)


def row(planner: str, found: Figures) -> str:
    """A row of the table."""
    count = len(found.every)
    head = f"| {planner} | {100 * len(found.solved) / count:.0f} % |"
    if not found.solved:
        return f"{head} - | - | - | {_times(found.every)} | {_reasons(found)} |"
    return (
        f"{head} {_times(found.solved)} | {np.mean(found.joint_way):.2f} | {np.mean(found.seconds):.1f} | "
        f"{_times(found.every)} | {_reasons(found)} |"
    )


def _times(seconds: list[float]) -> str:
    median, p95 = np.percentile(np.array(seconds) * 1e3, [50, 95])
    return f"{median:.1f} / {p95:.1f}"


def _reasons(found: Figures) -> str:
    texts = [f"{error} {count}" for error, count in sorted(found.errors.items(), key=lambda item: -item[1])]
    if found.colliding:
        texts.append(f"COLLIDING WHEN CHECKED AGAIN {found.colliding}")
    return ", ".join(texts) or "-"


def table(
    cell_name: str, scene: PlanningScene, pairs: list[tuple[Array, Array]], given: argparse.Namespace
) -> None:
    """Print the table of one robot."""
    cell = load_cell(cell_name)
    robot = RobotModel.load(cell.robot)
    print(f"\n{cell_name}: {len(pairs)} pairs, {'processor' if given.cpu else 'wall'} time\n")
    print("| planner | found | ms where found, median / 95 % | way [rad] | motion [s] | ms, all | not found because |")
    print("|---|---|---|---|---|---|---|")
    for planner in given.planner or PLANNERS:
        pipeline = PlanningPipeline(robot, cell.motion, Pipeline.model_validate({"planners": [{"name": planner}]}))
        print(row(planner, figures(planner, pipeline, scene, pairs, given.attempts, given.cpu)), flush=True)


def main() -> None:
    """Run all planners on both robots."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="?", type=Path, help="npz file with starts and goals (N, 7) of the Panda")
    parser.add_argument("--count", type=int, default=100, help="pairs of each robot at most")
    parser.add_argument("--robot", choices=["panda", "ur5"], help="only this one")
    parser.add_argument("--planner", action="append", choices=PLANNERS, help="only this one; may be repeated")
    parser.add_argument("--attempts", type=int, default=1, help="of sampling planners")
    parser.add_argument("--cpu", action="store_true", help="processor time: on a machine that has other work to do")
    given = parser.parse_args()
    if given.robot != "ur5":
        scene = table_with_balls()
        if given.pairs is not None:
            arrays = np.load(given.pairs)
            pairs = list(zip(arrays["starts"], arrays["goals"], strict=True))[: given.count]
        else:
            pairs = random_pairs(RobotModel.load(load_cell("panda").robot), scene, given.count)
        table("panda", scene, pairs, given)
    if given.robot != "panda":
        scene = ur5_scene()
        table("ur5", scene, random_pairs(RobotModel.load(load_cell("ur5").robot), scene, given.count), given)


if __name__ == "__main__":
    main()
