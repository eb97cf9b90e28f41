"""Planning compared with roboplan and OMPL on MotionBenchMaker's problems, in turn within one run.

    python -m benchmarks.peers FOLDER [--robot panda|ur5] [--set NAME] [--every N] [--step RAD] [--peers DIR]
                                      [--only roboplan|ompl]

FOLDER and problems are those of `benchmarks.mbm`. roboplan (0.7, C++ on pinocchio) and OMPL (2.0 from Python, with
pinocchio and coal's convex hulls) get an environment each, in DIR (build), which is made and filled by pip when it is
not there. They get the same robot (URDF, disabled pairs, fingers), solids, start and goal; RRT-Connect with edges
checked every --step (0.05) rad, and their own shortening; of their time counts the plan and the shortening, for which
they have 60 s. Of zencell's the planners' attempts count (`search`: straight edges, one attempt, its shortening), and
the whole pipeline with one attempt and as configured. Every path is judged by coal alone at 0.01 rad.
"""

from __future__ import annotations

import json
import subprocess
import venv
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.mbm import SETS, Problem, Referee, arguments, has_problems, load_robot, read
from common.messages import PlanResponse
from common.planning.collision import interpolate
from common.planning.pipeline import PlanningPipeline
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import timed_path
from common.planning.validation import fine_samples
from common.robot.packages import package_folders
from common.robot.transforms import pose_to_matrix

Array = NDArray[np.float64]

PEERS = {"roboplan": ["roboplan==0.7.0"], "ompl": ["ompl==2.0.1", "pin==4.1.0"]}  # what their environments hold
JUDGED = 0.01  # [rad]
WAYS = ("search", "one attempt", "configured")


class Peer:
    """Another planner in its own process."""

    def __init__(self, name: str, python: Path, hulls: RobotGeometry, step: float) -> None:
        """Start the process and send it the robot."""
        self.name = name
        script = Path(__file__).with_name(f"peer_{name}.py")
        self._process = subprocess.Popen(
            [python, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        robot = hulls.robot
        enabled = {frozenset((hulls.links[p.first], hulls.links[p.second])) for p in hulls.geometry.collisionPairs}
        links = sorted(set(hulls.links))
        pairs = [(a, b) for i, a in enumerate(links) for b in links[i + 1 :] if frozenset((a, b)) not in enabled]
        self.ask({
            "urdf": _fixed(robot.urdf, robot.config.locked_joints),
            "packages": [str(folder) for folder in package_folders(robot.config.package_dirs)],
            "joints": list(robot.joint_names), "disabled": pairs,
            "base": sorted({link for link, joint in zip(hulls.links, hulls.joints, strict=True) if joint == 0}),
            "step": step,
        })

    def ask(self, what: dict[str, Any]) -> dict[str, Any]:
        """Its answer."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(what) + "\n")
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.name} ended with code {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def plan(self, problem: Problem, seed: int) -> tuple[float, Array | None]:
        """Seconds, and waypoints (N, dof) [rad]."""
        solids = [
            {"name": solid.id, "shape": solid.shape, "dimensions": solid.dimensions,
             "T": pose_to_matrix(solid.pose).tolist()}
            for solid in problem.scene.objects
        ]
        start, goal = problem.start.tolist(), problem.goal.tolist()
        answer = self.ask({"solids": solids, "start": start, "goal": goal, "seed": seed})
        path = answer["path"]
        if answer["error"]:
            print(f"  {problem.name}: {self.name}: {answer['error']}")
        return answer["seconds"], None if path is None else np.array(path)


def _fixed(urdf: str, locked: dict[str, float]) -> str:
    """The URDF with locked joints as fixed ones, where they stand."""
    root = ET.fromstring(urdf)
    for joint in root.findall("joint"):
        at = locked.get(joint.get("name", ""))
        if at is None:
            continue
        origin, axis = joint.find("origin"), joint.find("axis")
        xyz, rpy = ([float(x) for x in (origin.get(key, "0 0 0") if origin is not None else "0 0 0").split()]
                    for key in ("xyz", "rpy"))
        along = np.array([float(x) for x in (axis.get("xyz", "1 0 0") if axis is not None else "1 0 0").split()])
        R = pin.rpy.rpyToMatrix(np.array(rpy))
        if joint.get("type") == "prismatic":
            xyz = (np.array(xyz) + R @ (at * along)).tolist()
        else:
            R = R @ pin.exp3(at * along)
        joint.set("type", "fixed")
        for child in list(joint):
            if child.tag not in ("parent", "child"):
                joint.remove(child)
        ET.SubElement(joint, "origin", xyz=" ".join(map(str, xyz)), rpy=" ".join(map(str, pin.rpy.matrixToRpy(R))))
    return ET.tostring(root, encoding="unicode")


def environment(folder: Path, packages: list[str]) -> Path:
    """The interpreter of an environment with these packages, made if it is not there."""
    python = folder / "bin" / "python"
    if not python.exists():
        print(f"making {folder} with {', '.join(packages)}", flush=True)
        venv.create(folder, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return python


def ways(
    pipeline: PlanningPipeline, peers: list[Peer], problem: Problem, seed: int
) -> Iterator[tuple[str, float, Array | None]]:
    """Seconds of each, and the path (N, dof) [rad] as it is judged."""
    for peer in peers:
        seconds, path = peer.plan(problem, seed)
        yield peer.name, seconds, None if path is None else interpolate(path, JUDGED)
    for name, attempts in (("one attempt", 1), ("configured", None)):
        began = perf_counter()
        response = pipeline.plan(problem.request(attempts, seed), problem.scene)
        seconds = perf_counter() - began
        found = _path(response)
        yield name, seconds, found
        if attempts == 1:
            yield "search", sum(attempt.seconds for attempt in response.attempts), found


def _path(response: PlanResponse) -> Array | None:
    if response.trajectory is None:
        return None
    return fine_samples(timed_path(response.trajectory), JUDGED)[0]


def main() -> None:
    """Compare on one robot."""
    parser = arguments(__doc__, every=5)
    parser.add_argument("--step", type=float, default=0.05, help="of the peers' checks [rad]")
    parser.add_argument("--peers", type=Path, default=Path("build"), help="where their environments are")
    parser.add_argument("--only", choices=PEERS, help="one of them")
    given = parser.parse_args()
    if not has_problems(given):
        return
    cell, robot = load_robot(given.robot)
    pipeline, hulls = PlanningPipeline(robot, cell.motion, cell.pipeline), RobotGeometry(robot)
    peers = [Peer(name, environment(given.peers / f"peer_{name}", packages), hulls, given.step)
             for name, packages in PEERS.items() if given.only in (None, name)]
    print(f"{given.robot}, wall ms median / 95 %, way [rad], found, colliding when judged at {JUDGED} rad")
    for name, problems in read(given.folder, robot, given.robot, given.set or list(SETS), given.every, False):
        seconds: dict[str, list[float]] = defaultdict(list)
        lengths: dict[str, list[float]] = defaultdict(list)
        colliding: dict[str, int] = defaultdict(int)
        for seed, problem in enumerate(problems, 1):
            referee = Referee(hulls, problem.scene)
            if referee.collides(problem.start) or referee.collides(problem.goal):
                continue
            for way, took, path in ways(pipeline, peers, problem, seed):
                seconds[way].append(took)
                if path is not None:
                    lengths[way].append(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()))
                    colliding[way] += any(referee.collides(q) for q in path)
        for way in (*(peer.name for peer in peers), *WAYS):
            median, high = np.percentile(1e3 * np.array(seconds[way]), [50, 95])
            length = np.median(lengths[way]) if lengths[way] else np.nan
            print(f"{name:18} {way:12} {median:9.2f} / {high:9.2f}  {length:6.3f}  {len(lengths[way]):3} of "
                  f"{len(seconds[way]):3}  {colliding[way]:3}", flush=True)


if __name__ == "__main__":
    main()
