"""MotionBenchMaker's problems through the whole pipeline: what is solved, how fast, how long the paths are.

    python -m benchmarks.mbm FOLDER --robot panda|ur5 [--set NAME] [--every N] [--odd] [--attempts N] [--cpu]
                             [--json F] [--paths F.npz]

FOLDER holds `panda.tar.bz2` and `ur5.tar.bz2`: seven sets of problems by Rice University's Kavraki Lab (Chamzas et
al., "MotionBenchMaker", RA-L 7(2), 2022), MoveIt's messages as YAML. The frame is the robot's base, the
Panda's fingers stand at 0.065 m each as in the files, and starts and goals that lie a little beyond the limits are
clipped. Of the robot the hulls and disabled pairs of the cell count, so some problems are not valid and left out.

Times are those of the whole pipeline (checks, planning, retiming, validation), of all valid problems. Every trajectory
is checked again at 0.005 rad by coal on the hulls alone. --json writes {set: {valid, solved, colliding, median_ms,
p95_ms, length}}, the length [rad] being the median of the way through joint space; --paths writes each path's positions
(N, dof), no joint moving by more than 0.005 rad between them, under `<set>/<number>`.
"""

from __future__ import annotations

import argparse
import json
import tarfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import yaml
from numpy.typing import NDArray

from common.config import Cell, load_cell
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest
from common.planning.pipeline import PlanningPipeline
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, pose_to_matrix

Array = NDArray[np.float64]

SETS = ("bookshelf_small", "bookshelf_tall", "bookshelf_thin", "box", "cage", "table_pick", "table_under_pick")
RECHECK_STEP = 0.005  # [rad]
CHANGES: dict[str, dict[str, Any]] = {
    "panda": {"locked_joints": {"panda_finger_joint1": 0.065, "panda_finger_joint2": 0.065}},
    "ur5": {"base_position": (0.0, 0.0, 0.0)},
}


@dataclass
class Problem:
    """Solids about the robot, where it starts and where it is to go (dof,) [rad]."""

    name: str
    scene: PlanningScene
    start: Array
    goal: Array

    def request(self, attempts: int | None, seed: int) -> PlanRequest:
        """To the goal; with so many attempts, or as many as are configured."""
        goal = JointGoal(positions=self.goal.tolist())
        return PlanRequest(id="problem", start=self.start.tolist(), goal=goal, planning_attempts=attempts, seed=seed)


@dataclass
class Figures:
    """What became of the problems of a set."""

    seconds: list[float] = field(default_factory=list)
    lengths: list[float] = field(default_factory=list)
    colliding: int = 0

    def summary(self) -> dict[str, float]:
        """The keys of the file that --json names."""
        median, p95 = np.percentile(np.array(self.seconds or [0.0]) * 1e3, [50, 95])
        return {
            "valid": len(self.seconds),
            "solved": len(self.lengths),
            "colliding": self.colliding,
            "median_ms": round(float(median), 3),
            "p95_ms": round(float(p95), 3),
            "length": round(float(np.median(self.lengths)), 4) if self.lengths else 0.0,
        }


def load_robot(name: str) -> tuple[Cell, RobotModel]:
    """The cell of a robot, and the robot as the problems mean it."""
    cell = load_cell(name)
    return cell, RobotModel.load(cell.robot.model_copy(update=CHANGES[name]))


def read(folder: Path, robot: RobotModel, name: str, chosen: list[str], every: int, odd: bool) -> Iterator[
    tuple[str, list[Problem]]
]:
    """The problems of each set in the order of their numbers, every n-th of them; `odd`: of those with odd numbers."""
    texts: dict[str, bytes] = {}
    with tarfile.open(folder / f"{name}.tar.bz2") as archive:
        for member in archive:
            content = archive.extractfile(member) if member.isfile() else None
            if content is not None:
                texts["/".join(Path(member.name).parts[-2:])] = content.read()
    for one in chosen:
        keys = sorted(key for key in texts if key.startswith(f"{one}_{name}/request"))
        numbers = [key[-9:-5] for key in keys]
        numbers = [number for number in numbers if int(number) % 2 or not odd][::every]
        yield one, [_problem(robot, texts, f"{one}_{name}", number) for number in numbers]


def _problem(robot: RobotModel, texts: dict[str, bytes], folder: str, number: str) -> Problem:
    scene, request = (
        yaml.load(texts[f"{folder}/{kind}{number}.yaml"], Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        for kind in ("scene", "request")
    )
    state = request["start_state"]["joint_state"]
    start = robot.order(state["name"], state["position"])
    joints = request["goal_constraints"][0]["joint_constraints"]
    goal = robot.order([joint["joint_name"] for joint in joints], [joint["position"] for joint in joints])
    assert start is not None and goal is not None
    solids = [
        _solid(f"{item['id']}_{i}", primitive, _matrix(item.get("pose")) @ _matrix(pose))
        for item in scene["world"]["collision_objects"]
        for i, (primitive, pose) in enumerate(
            zip(item.get("primitives", []), item.get("primitive_poses", []), strict=True)
        )
    ]
    header = Header(frame_id="world")
    ends = (np.clip(q, robot.lower, robot.upper) for q in (start, goal))
    return Problem(f"{folder}/{number}", PlanningScene(header=header, objects=solids), *ends)


def _matrix(pose: dict[str, list[float]] | None) -> Array:
    T = np.eye(4)
    if pose:
        x, y, z, w = pose.get("orientation", [0, 0, 0, 1])
        T[:3, :3] = pin.Quaternion(w, x, y, z).normalized().matrix()
        T[:3, 3] = pose.get("position", [0, 0, 0])
    return T


def _solid(name: str, primitive: dict[str, Any], T_world_solid: Array) -> CollisionObject:
    dimensions = list(primitive["dimensions"])
    if primitive["type"] == "cylinder":
        dimensions.reverse()  # MoveIt's height, radius
    return CollisionObject.model_validate(
        {
            "id": name,
            "role": "fixture",
            "shape": primitive["type"],
            "dimensions": dimensions,
            "pose": matrix_to_pose(T_world_solid),
        }
    )


class Referee:
    """Collision of the hulls with each other and with the solids by coal alone, pair by pair."""

    def __init__(self, hulls: RobotGeometry, scene: PlanningScene) -> None:
        """Add the solids of a scene to the hulls; everything but the base must stay clear of them."""
        self._model = hulls.robot.model
        self._geometry = hulls.geometry.copy()
        for item in scene.objects:
            sides = item.dimensions
            shape = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere}[item.shape](*sides)
            solid = self._geometry.addGeometryObject(
                pin.GeometryObject(item.id, 0, 0, pin.SE3(pose_to_matrix(item.pose)), shape)
            )
            for link, joint in enumerate(hulls.joints):
                if joint:
                    self._geometry.addCollisionPair(pin.CollisionPair(link, solid))
        self._data = self._model.createData()
        self._shapes = pin.GeometryData(self._geometry)

    def collides(self, q: Array) -> bool:
        """Whether anything touches at q (dof,) [rad]."""
        return bool(pin.computeCollisions(self._model, self._data, self._geometry, self._shapes, q, True))


def run(
    pipeline: PlanningPipeline, hulls: RobotGeometry, problems: list[Problem], given: argparse.Namespace
) -> tuple[Figures, dict[str, Array]]:
    """Figures of one set, and the paths."""
    clock = time.process_time if given.cpu else time.perf_counter
    figures, paths = Figures(), {}
    for problem in problems:
        referee = Referee(hulls, problem.scene)
        if referee.collides(problem.start) or referee.collides(problem.goal):
            continue
        request = problem.request(given.attempts, given.seed)
        began = clock()
        response = pipeline.plan(request, problem.scene)
        figures.seconds.append(clock() - began)
        if response.trajectory is None:
            print(f"  {problem.name}: {response.message}", flush=True)
            continue
        path, _ = fine_samples(timed_path(response.trajectory), RECHECK_STEP)
        figures.lengths.append(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()))
        figures.colliding += any(referee.collides(q) for q in path)
        paths[problem.name] = path
    return figures, paths


def arguments(about: str | None, every: int) -> argparse.ArgumentParser:
    """A parser that knows where the problems are and which of them are used: every n-th by default."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, help="holds panda.tar.bz2 and ur5.tar.bz2")
    parser.add_argument("--robot", choices=list(CHANGES), default="panda")
    parser.add_argument("--set", action="append", choices=SETS, help="only this one; may be repeated")
    parser.add_argument("--every", type=int, default=every, metavar="N", help="only every N-th problem")
    return parser


def has_problems(given: argparse.Namespace) -> bool:
    """Whether the folder holds those of the robot; says so where it does not."""
    if given.folder is not None and (given.folder / f"{given.robot}.tar.bz2").is_file():
        return True
    print(f"problems skipped: {given.folder or 'no folder'} holds no {given.robot}.tar.bz2")
    return False


def main() -> None:
    """Run the sets of one robot."""
    parser = arguments(__doc__, every=1)
    parser.add_argument("--odd", action="store_true", help="only problems with odd numbers")
    parser.add_argument("--attempts", type=int, help="planning attempts; else as configured")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cpu", action="store_true", help="processor time: on a machine that has other work to do")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--paths", type=Path, help="npz file for the paths")
    given = parser.parse_args()
    if not has_problems(given):
        return
    cell, robot = load_robot(given.robot)
    pipeline, hulls = PlanningPipeline(robot, cell.motion, cell.pipeline), RobotGeometry(robot)
    print(f"{given.robot}, {'processor' if given.cpu else 'wall'} time, {given.attempts or 'configured'} attempts")
    print(f"{'set':20} valid solved colliding  median [ms]     p95 [ms]  length [rad]")
    found: dict[str, dict[str, float]] = {}
    paths: dict[str, Array] = {}
    for name, problems in read(given.folder, robot, given.robot, given.set or list(SETS), given.every, given.odd):
        figures, ways = run(pipeline, hulls, problems, given)
        s = found[name] = figures.summary()
        paths |= ways
        print(
            f"{name:20} {s['valid']:5} {s['solved']:6} {s['colliding']:9} {s['median_ms']:12.2f} {s['p95_ms']:12.2f} "
            f"{s['length']:13.3f}",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if given.paths:
        np.savez_compressed(given.paths, **paths)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
