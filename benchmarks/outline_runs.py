"""Whole runs of the UR5 cell: how exactly each world was outlined, how evenly, and whether the arm touched anything.

`python -m benchmarks.outline_runs` outlines the object of w1 to w6 at speed 1 and says how long it took from picture to
planned motions, and where that time went. The way that the arm took is checked again at 0.01 rad against what is fixed
and against all objects where they really are; only the finger tips may touch what they trace.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from applications.outlining.recording import distances
from applications.outlining.topics import (
    CONTOUR_PATH,
    CONTOUR_POINTS,
    CONTOURS,
    OUTLINE_STATUS,
    OutlinePoints,
    OutlineStatus,
)
from common import topics
from common.config import Cell, Surroundings, load_cell
from common.messages import (
    CollisionObject,
    Header,
    JointState,
    PlanningScene,
    Pose,
    Vector3,
)
from common.planning.collision import CollisionWorld, Hit, interpolate
from common.robot.model import RobotModel
from common.scene.fixtures import fixture_objects
from common.sim.objects import world_object
from common.transport.bus import Bus, Reader
from tests.harness import RunningCell, folder_for, running_with

Array = NDArray[np.float64]

WORLDS = ("w1", "w2", "w3", "w4", "w5", "w6")
TIMEOUT = 240.0  # [s] for one run
STEP = 0.01  # [rad] between the positions that are checked
CORNER = 0.2  # [rad] a contour that turns more than this within `ABOUT` has a corner there
ABOUT = 0.006  # [m] about a corner the tool may be slower
MOTIONS = 5


@dataclass
class Watched:
    """What a cell said while it outlined, and how old a picture was [ms] when each stage was done with it."""

    joints: list[JointState] = field(default_factory=list)
    path: OutlinePoints | None = None
    began: int = 0
    ended: int = 0
    ages: dict[str, float] = field(default_factory=dict)


async def watch(bus: Bus, seen: Watched) -> None:
    """Collect until cancelled."""
    ages: dict[str, dict[int, float]] = {}

    async def stamped(name: str, reader: Reader[Any]) -> None:
        async for message in reader:
            ages.setdefault(name, {}).setdefault(message.header.stamp, bus.clock.age_ms(message.header.stamp))

    async def joints() -> None:
        async for state in bus.reader(topics.JOINT_STATES):
            seen.joints.append(state)

    async def paths() -> None:
        async for path in bus.reader(CONTOUR_PATH):
            ages.setdefault("path", {}).setdefault(path.header.stamp, bus.clock.age_ms(path.header.stamp))
            if path.poses and not seen.ages:
                seen.path = path

    async def statuses() -> None:
        before: OutlineStatus | None = None
        async for status in bus.reader(OUTLINE_STATUS):
            if len(status.plans) == MOTIONS and seen.path is not None and not seen.ages:
                stamp = seen.path.header.stamp
                seen.ages = {name: known[stamp] for name, known in ages.items() if stamp in known}
                seen.ages["planned"] = bus.clock.age_ms(stamp)
            if status.state == "TRACING" and (before is None or before.state != "TRACING"):
                seen.began = status.header.stamp
            elif status.state != "TRACING" and before is not None and before.state == "TRACING":
                seen.ended = status.header.stamp
            before = status

    async with running_with(
        joints(), paths(), stamped("picture", bus.reader(topics.DEPTH_CAMERA_IMAGE)),
        stamped("contours", bus.reader(CONTOURS)), stamped("points", bus.reader(CONTOUR_POINTS)),
        stamped("scene", bus.reader(topics.PLANNING_SCENE)),
    ):
        await statuses()


@dataclass
class Result:
    """One run."""

    label: str
    exit_code: int
    outline: dict[str, Any]
    ages: dict[str, float]
    evenness: float  # largest departure from the set speed away from corners, as a share of it
    hit: Hit | None
    checked: int

    @property
    def good(self) -> bool:
        """Whether everything holds."""
        figures = self.outline
        return (
            self.exit_code == 0 and figures["fraction"] == 1.0 and figures["closed"] and self.hit is None
            and figures["deviation_mm"]["max"] < 0.5 and self.evenness < 0.1
        )

    def __str__(self) -> str:
        figures, ages = self.outline, self.ages
        if not figures.get("deviation_mm"):
            return f"{self.label}: exit {self.exit_code}, nothing outlined"
        stages = ", ".join(f"{name} {age:.0f}" for name, age in sorted(ages.items(), key=lambda item: item[1]))
        aged = f"; age of the picture [ms]: {stages}" if stages else ""
        touched = f"{self.hit.pair[0]} - {self.hit.pair[1]}" if self.hit else "nothing"
        return (
            f"{self.label}: exit {self.exit_code}, {figures['points']} points, {figures['length_m']:.3f} m, "
            f"fraction {figures['fraction']:.2f}, {'closed' if figures['closed'] else 'open'}, true outline "
            f"{figures['deviation_mm']['mean']:.3f} mm ({figures['deviation_mm']['max']:.3f}), contour "
            f"{figures['tracking_mm']['mean']:.3f} mm ({figures['tracking_mm']['max']:.3f}), speed within "
            f"{self.evenness:.1%}, touched {touched} in {self.checked} positions{aged}"
        )


def evenness(robot: RobotModel, states: list[JointState], corners: Array, speed: float) -> float:
    """Largest departure of the tool from a speed as a share of it, away from corners and both ends.

    Args:
        robot: the model.
        states: while it traced.
        corners: (M, 3) [m] of the contour.
        speed: that was asked for [m/s].
    """
    tips, moved = [], []
    for state in states:
        q, dq = robot.order(state.name, state.position), robot.order(state.name, state.velocity)
        assert q is not None and dq is not None
        tips.append(robot.fk(q)[:3, 3])
        moved.append(np.linalg.norm(robot.fk(q + 1e-4 * dq)[:3, 3] - tips[-1]) / 1e-4)
    places = np.array(tips)
    ends = np.concatenate([places[:1], places[-1:], corners])
    away = np.linalg.norm(places[:, None] - ends[None], axis=2).min(axis=1) > ABOUT
    return float(np.abs(np.array(moved)[away] / speed - 1).max()) if away.any() else 0.0


def corners_of(path: Array) -> Array:
    """Those of the points (N, 3) [m] of a closed contour about which it turns sharply."""
    edges = np.roll(path, -1, axis=0) - path
    lengths = np.linalg.norm(edges, axis=1)
    angles = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
    found = []
    for i in range(len(path)):
        turned, way, k = 0.0, 0.0, i
        while way < ABOUT and k < i + len(path):  # what it turns from the edge before on
            a, b = angles[(k - 1) % len(path)], angles[k % len(path)]
            turned += float((b - a + np.pi) % (2 * np.pi) - np.pi)
            way += float(lengths[k % len(path)])
            k += 1
        if abs(turned) > CORNER + ABOUT / 0.02:  # a circle of 2 cm turns by so much
            found.append(path[i])
    return np.array(found).reshape(-1, 3)


def first_contact(cell: Cell, robot: RobotModel, states: Array, path: Array) -> tuple[Hit | None, int]:
    """The first contact on a way (N, dof) [rad] with what is really there, and how many positions were checked."""
    surroundings = cell.section(Surroundings)
    assert isinstance(surroundings, Surroundings) and cell.robot.gripper is not None
    truth = [world_object(thing) for thing in cell.world.objects]
    objects = list(fixture_objects(surroundings))
    for thing in truth:
        middle = Pose(position=Vector3(z=thing.base + thing.height / 2))
        objects.append(CollisionObject(id=thing.id, role="target", shape="prism", dimensions=[thing.height],
                                       outline=thing.outline, pose=middle))
    tops = {t.id: np.column_stack([np.array(t.outline), np.full(len(t.outline), t.base + t.height)]) for t in truth}
    traced = min(tops, key=lambda name: float(distances(path, tops[name]).mean()))
    world = CollisionWorld(
        robot, PlanningScene(header=Header(frame_id="world"), objects=objects), start=states[0],
        allowed=[(link, traced) for link in cell.robot.gripper.links],
    )
    fine = interpolate(states, STEP)
    return world.first_collision(fine), len(fine)


async def outline(label: str, arguments: list[str], folder: Path) -> Result:
    """One run of the cell."""
    seen = Watched()
    with RunningCell(folder, "run", "ur5", *arguments) as running:
        async with running.listen() as bus:
            watching = asyncio.create_task(watch(bus, seen))
            code = await running.ended(TIMEOUT)
            watching.cancel()
        figures = running.summary["outline"]
    if seen.path is None or not seen.joints or not seen.ended:
        return Result(label, code, figures, seen.ages, 1.0, None, 0)
    world = arguments[arguments.index("--world") + 1] if "--world" in arguments else None
    overrides = [arguments[i + 1] for i, word in enumerate(arguments) if word == "--set"]
    cell = load_cell("ur5", overrides, world=world)
    robot = RobotModel.load(cell.robot)
    states = np.array([robot.order(s.name, s.position) for s in seen.joints])
    during = [state for state in seen.joints if seen.began <= state.header.stamp <= seen.ended]
    path = np.array([(p.position.x, p.position.y, p.position.z) for p in seen.path.poses])
    even = evenness(robot, during, corners_of(path), 0.05)
    hit, checked = first_contact(cell, robot, states, path)
    return Result(label, code, figures, seen.ages, even, hit, checked)


async def run_all(options: argparse.Namespace, folder: Path) -> int:
    """All runs, one after the other; 1 if one of them is not as it must be."""
    failed = []
    for world in options.worlds.split(","):
        arguments = ["--world", world, "--speed", str(options.speed)]
        for text in options.set:
            arguments += ["--set", text]
        result = await outline(world, arguments, folder_for(folder, world))
        if options.speed != 1:  # the clock here is that of the wall
            result.ages.clear()
        print(result, flush=True)
        failed += [] if result.good else [world]
    print(f"not as it must be: {', '.join(failed)}" if failed else "all as it must be")
    return 1 if failed else 0


def main() -> int:
    """Run what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", default=",".join(WORLDS), help="such as w1,w4")
    parser.add_argument("--speed", type=float, default=1.0, help="of the cell; ages of pictures are right at 1 only")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="as of zencell run")
    parser.add_argument("--folder", help="where logs and summaries go")
    options = parser.parse_args()
    folder = Path(options.folder or tempfile.mkdtemp(prefix="zencell-outlines-"))
    print(f"logs and summaries are in {folder}")
    return asyncio.run(run_all(options, folder))


if __name__ == "__main__":
    raise SystemExit(main())
