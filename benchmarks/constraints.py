"""Ways that keep to constraints: a glass carried upright over a wall, and the tool inside a corridor.

    python -m benchmarks.constraints [--robot panda|ur5 ...] [--count N] [--planner NAME ...] [--time S]

Problems: the tool is upright on one side of a wall, turned about its axis and leaning at random, and must be so
on the other side, in a corridor or not. Both ends have a solution near to the home pose: from one posture of the arm to
another there may be no way that keeps the tool upright. Printed for each: how many are solved within --time of wall
time, and processor time of the whole pipeline. Trajectories are judged again by pinocchio at every millisecond; ends
with 1 where one breaks a constraint.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from common.config import load_cell
from common.messages import PathConstraints, PlanRequest, PlanResponse, PoseGoal
from common.planning.constraints import PLACE_TOLERANCE, TILT_TOLERANCE
from common.planning.pipeline import PlanningPipeline
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose
from tests.common.planning.constraint_checks import FLOOR, carries, constraints_of, driven, walled

CONSTRAINTS = ("tilt 0.3", "tilt 0.1", "tilt 0.03", "corridor", "tilt 0.1, corridor")


def broken(robot: RobotModel, response: PlanResponse, wanted: PathConstraints) -> bool:
    """Whether a trajectory breaks a constraint at any millisecond."""
    way = driven(robot, response)
    if wanted.region is not None and way.outside(wanted.region) > PLACE_TOLERANCE:
        return True
    return wanted.tilt is not None and way.tilt() > wanted.tilt + TILT_TOLERANCE


def _line(name: str, what: str, planner: str, count: int, seconds: float) -> bool:
    cell = load_cell(name)
    robot = RobotModel.load(cell.robot)
    pipeline = PlanningPipeline(robot, cell.motion, load_cell("panda").pipeline)
    wanted, scene = constraints_of(what, name), walled(name)
    lean = 0.5 * wanted.tilt if wanted.tilt else 0.5
    times, solved, ways, wrong = [], 0, [], False
    for number, carry in enumerate(carries(robot, name, count, lean)):
        request = PlanRequest(
            id="carry", start=carry.start.tolist(), goal=PoseGoal(pose=matrix_to_pose(carry.T_world_goal)), seed=number,
            constraints=wanted, planning_time=seconds, planner=planner,
        )
        began = time.process_time()
        response = pipeline.plan(request, scene)
        times.append(time.process_time() - began)
        if response.trajectory is not None:
            solved += 1
            ways.append(response.trajectory.points[-1].time_from_start)
            wrong |= broken(robot, response, wanted)
    median, p95 = (1e3 * float(np.percentile(times, share)) for share in (50, 95))
    motion = f"{np.median(ways):.1f}" if ways else "-"
    sys.stdout.write(
        f"| {name} | {what} | {planner or 'all'} | {solved} of {count} | {median:.0f} / {p95:.0f} | {motion} |\n")
    sys.stdout.flush()
    return wrong


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", nargs="+", choices=sorted(FLOOR), default=sorted(FLOOR))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--planner", nargs="+", default=[""])
    parser.add_argument("--time", type=float, default=5.0)
    given = parser.parse_args()
    sys.stdout.write(
        "| robot | keeps | planner | solved | processor ms, median / 95 % | motion, s |\n|---|---|---|---|---|---|\n")
    lines = [(robot, what, planner) for robot in given.robot for what in CONSTRAINTS for planner in given.planner]
    return int(sum(_line(*each, given.count, given.time) for each in lines) > 0)


if __name__ == "__main__":
    sys.exit(main())
