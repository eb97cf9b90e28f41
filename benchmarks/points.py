"""Planning among what cameras see: set-up, and how it grows with points and with primitives.

    python -m benchmarks.points [--robot panda|ur5] [--pairs N] [--points N ...] [--primitives N ...] [--json F]

Ten boxes stand about the robot, seen by two cameras as so many points on their surfaces, a tenth of them on the robot
itself; or so many primitives stand there, which together are as large. Pairs of random free positions are planned
through the whole pipeline as configured, the same for all numbers of points. Set-up is all that comes before planning
in a request: the robot and the scene are taken out, points are downsampled, the collision world is made with
shapes that it has had before. Every trajectory is looked at again at 0.005 rad against the boxes themselves; ends
with 1 where one collides, but for fewer than 100,000 points, which are too far apart to show the boxes. Times are
[ms]: wall, and of the process on all processors ("cpu").
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from common.config import load_cell
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest, Pose, Vector3
from common.planning.collision import CollisionWorld, interpolate
from common.planning.obstacles import ObstacleCache
from common.planning.pipeline import PlanningPipeline
from common.planning.point_obstacles import CameraView, KnownShapeFilter, PointObstacle
from common.robot.model import RobotModel

Array = NDArray[np.float64]

BOXES = 10
WORLD = Header(frame_id="world")
COLUMNS = ("spheres", "set_up", "set_up_cpu", "state_us", "edge_us", "plan", "plan_p95", "plan_cpu", "solved", "hits")


class Bench:
    """A robot, boxes about it, and pairs of positions that are free of them."""

    def __init__(self, robot: str, pairs: int, seed: int) -> None:
        cell = load_cell(robot)
        self.robot, self.padding = RobotModel.load(cell.robot), cell.motion.object_padding
        self.pipeline = PlanningPipeline(self.robot, cell.motion, cell.pipeline)
        self.known = KnownShapeFilter(self.pipeline.geometry)
        self.seed, self.pairs = seed, pairs
        self.boxes = self.primitives(BOXES)
        self.home = self.robot.named("home")
        self.nothing = _scene([])
        self.requests = self._requests(_scene(self.boxes), 0.04)

    def primitives(self, count: int) -> list[CollisionObject]:
        """Boxes, spheres and cylinders about the robot that together are as large, whatever their number."""
        rng, found = np.random.default_rng(self.seed), []
        foot, reach = np.array(self.robot.foot), self.robot.reach
        size = 0.16 * (BOXES / count) ** (1 / 3) * reach
        for i in range(count):
            angle, far, up = rng.uniform(-np.pi, np.pi), rng.uniform(0.4, 0.95), rng.uniform(-0.1, 0.8)
            x, y, z = foot + reach * np.array([far * np.cos(angle), far * np.sin(angle), up])
            kind = ("box", "sphere", "cylinder")[i % 3] if count != BOXES else "box"
            sides = {"box": [size] * 3, "sphere": [0.6 * size], "cylinder": [0.5 * size, size]}[kind]
            pose = Pose(position=Vector3(x=x, y=y, z=z))
            found.append(CollisionObject(id=f"{kind}_{i}", role="target", shape=kind, dimensions=sides, pose=pose))
        return found

    def _requests(self, scene: PlanningScene, padding: float) -> list[PlanRequest]:
        rng = np.random.default_rng(self.seed + 1)
        free: list[list[float]] = []
        world = CollisionWorld(self.robot, scene, start=self.home, padding=padding, cache=self._cache())
        while len(free) < 2 * self.pairs:
            q = rng.uniform(self.robot.lower, self.robot.upper)
            if not world.collides(q):
                free.append(q.tolist())
        return [
            PlanRequest(id=str(i), start=free[2 * i], goal=JointGoal(positions=free[2 * i + 1]), seed=i)
            for i in range(self.pairs)
        ]

    def _cache(self) -> ObstacleCache:
        return ObstacleCache(self.pipeline.geometry)

    def views(self, count: int) -> list[CameraView]:
        """So many points on the boxes and on the robot, half of them from each of two cameras."""
        rng, middles = np.random.default_rng(self.seed + 2), np.array([list(_at(box)) for box in self.boxes])
        side = self.boxes[0].dimensions[0]
        on = rng.uniform(-0.5, 0.5, (count, 3)) * side
        face = rng.integers(3, size=count)
        on[np.arange(count), face] = np.copysign(0.5 * side, on[np.arange(count), face])
        points = middles[rng.integers(BOXES, size=count)] + on
        own = rng.uniform(size=count) < 0.1
        links = np.array([T[:3, 3] for T in self.robot.link_poses(self.home).values()])
        points[own] = links[rng.integers(len(links), size=int(own.sum()))]
        return [CameraView(f"camera_{k}", points[k::2], self.home) for k in range(2)]

    def world(self, scene: PlanningScene, points: list[PointObstacle], cache: ObstacleCache) -> CollisionWorld:
        """The world at home."""
        return CollisionWorld(self.robot, scene, start=self.home, padding=self.padding, cache=cache, points=points)

    def of_points(self, count: int) -> dict[str, float]:
        """Figures of so many points."""
        views, cache = self.views(count), self._cache()
        points: list[PointObstacle] = []

        def set_up() -> CollisionWorld:
            points[:] = [self.known.obstacle(view, self.nothing) for view in views]
            return self.world(self.nothing, points, cache)

        set_up()
        times = [_timed(set_up) for _ in range(7)]
        figures = self._asked(set_up(), self.requests)
        figures |= {"set_up": _median(times, 0), "set_up_cpu": _median(times, 1)}
        figures["spheres"] = sum(len(obstacle.spheres) for obstacle in points)
        return figures | self._planned(self.nothing, points, self.requests, _scene(self.boxes))

    def of_primitives(self, count: int) -> dict[str, float]:
        """Figures of so many primitives."""
        scene, cache = _scene(self.primitives(count)), self._cache()
        self.world(scene, [], cache)
        times = [_timed(lambda: self.world(scene, [], cache)) for _ in range(7)]
        requests = self._requests(scene, 0.04)
        figures = self._asked(self.world(scene, [], cache), requests)
        figures |= {"set_up": _median(times, 0), "set_up_cpu": _median(times, 1)}
        return figures | self._planned(scene, [], requests, scene)

    def _asked(self, world: CollisionWorld, requests: list[PlanRequest]) -> dict[str, float]:
        """Processor time of a state and of an edge [us]."""
        rng = np.random.default_rng(self.seed + 3)
        states = rng.uniform(self.robot.lower, self.robot.upper, (1000, self.robot.dof))
        ends = [(np.array(r.start), np.array(r.goal.positions)) for r in requests]  # type: ignore[union-attr]
        edges = [(a, a + (b - a) * min(1.0, 1.0 / float(np.linalg.norm(b - a)))) for a, b in ends]
        _, state = _timed(lambda: [world.collides(q) for q in states])
        _, edge = _timed(lambda: [world.edge_free(a, b) for a, b in edges])
        return {"state_us": 1e3 * state / len(states), "edge_us": 1e3 * edge / len(edges)}

    def _planned(
        self, scene: PlanningScene, points: list[PointObstacle], requests: list[PlanRequest], truth: PlanningScene
    ) -> dict[str, float]:
        times, solved, hits = [], 0, 0
        for request in requests:
            began, worked = time.perf_counter(), time.process_time()
            response = self.pipeline.plan(request, scene, points=points)
            times.append((1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - worked)))
            if response.ok and response.trajectory is not None:
                solved += 1
                path = interpolate(np.array([point.positions for point in response.trajectory.points]), 0.005)
                world = CollisionWorld(self.robot, truth, start=path[0], cache=self._cache())
                hits += int(world.first_collision(path) is not None)
        wall = [one for one, _ in times]
        return {
            "plan": float(np.median(wall)), "plan_p95": float(np.percentile(wall, 95)), "plan_cpu": _median(times, 1),
            "solved": solved / len(requests), "hits": hits,
        }


def _at(thing: CollisionObject) -> tuple[float, float, float]:
    return thing.pose.position.x, thing.pose.position.y, thing.pose.position.z


def _scene(objects: list[CollisionObject]) -> PlanningScene:
    # Not checked: a message may hold 500 objects.
    return PlanningScene.model_construct(header=WORLD, objects=objects, attached=[], allowed_collisions=[])


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor time [ms]."""
    began, worked = time.perf_counter(), time.process_time()
    work()
    return 1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - worked)


def _median(times: list[tuple[float, float]], which: int) -> float:
    return float(np.median([one[which] for one in times]))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--robot", choices=("panda", "ur5"), default="panda")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--points", type=int, nargs="*", default=[10**3, 10**4, 10**5, 10**6])
    parser.add_argument("--primitives", type=int, nargs="*", default=[10, 100, 1000])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    sparse = {f"{count} points" for count in options.points if count < 100_000}
    bench, table = Bench(options.robot, options.pairs, options.seed), {}
    sys.stdout.write(f"{'':>18} " + " ".join(f"{name:>11}" for name in COLUMNS) + "\n")
    for what, counts, figures in (
        ("points", options.points, bench.of_points), ("primitives", options.primitives, bench.of_primitives)
    ):
        for count in counts:
            table[f"{count} {what}"] = found = figures(count)
            numbers = " ".join(f"{found[name]:>11.2f}" if name in found else f"{'':>11}" for name in COLUMNS)
            sys.stdout.write(f"{count:>7} {what:<10} {numbers}\n")
            sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(table, indent=1))
    return 1 if any(found["hits"] for name, found in table.items() if name not in sparse) else 0


if __name__ == "__main__":
    sys.exit(main())
