"""Replacement of the perception in simulations: objects and one grasp of each from the simulated truth, no images."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.sorting.topics import HEAP, Grasp, Heap, Left, SeenObject
from common import messages as m
from common import topics
from common.config import Parameters, RobotConfig, Surroundings, Tunable
from common.errors import ConfigError
from common.planning.ik import solve_ik
from common.process.service import main
from common.process.timing import LoopRate
from common.robot.home import HomeMonitor
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, tool_down
from common.transport.bus import Bus

Array = npt.NDArray[np.float64]

APPROACH = 0.10  # [m]
DEPTH = 0.03  # [m] of the finger tips below the top
LOWEST = 0.008  # [m] of the finger tips above the support
SLACK = 0.02  # [m] by which the fingers open wider than an object
YAWS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
NAMES = {"red": (1, 0, 0), "orange": (1, 0.5, 0), "yellow": (1, 1, 0), "green": (0, 0.8, 0), "blue": (0, 0, 1),
         "purple": (0.6, 0, 0.6), "white": (1, 1, 1), "grey": (0.5, 0.5, 0.5), "black": (0, 0, 0)}


class Config(Parameters):
    """How often a picture is reported."""

    robot: RobotConfig
    world: Surroundings
    tray: str = Field("tray", description="id of the container that objects are taken from")
    rate: Tunable[float] = Field(5.0, gt=0, le=50, description="looks per second of cell time [Hz]")


def seen(thing: m.WorldObject) -> SeenObject:
    """Return an upright object as it would be seen."""
    at, size = thing.pose.position, thing.size
    corners = np.array(thing.outline, float).reshape(-1, 2)
    half = math.hypot(size.x, size.y) / 2
    outline = [(float(x), float(y)) for x, y in corners] or [(at.x + half * dx, at.y + half * dy) for dx, dy in (
        (1, 1), (-1, 1), (-1, -1), (1, -1))]
    yaw = 2 * math.atan2(thing.pose.orientation.z, thing.pose.orientation.w)
    c = thing.color
    name = min(NAMES, key=lambda each: math.dist(NAMES[each], (c.r, c.g, c.b)))
    shape = {"sphere": "round", "cylinder": "round", "ring": "ring", "box": "box"}.get(thing.shape, "other")
    return SeenObject(
        id=thing.id, place=thing.container or "table", center=m.Vector3(x=at.x, y=at.y, z=at.z + size.z / 2),
        size=size, yaw=yaw, outline=outline[:64], top=at.z + size.z / 2, bottom=at.z - size.z / 2,
        volume=size.x * size.y * size.z, color=thing.color, color_name=name, shape=shape)


class TopDown:
    """Finds one grasp from above for each object, with the fingers across its narrow side."""

    def __init__(self, config: RobotConfig) -> None:
        """Load the robot.

        Raises:
            ConfigError: it has no gripper.
        """
        if config.gripper is None:
            raise ConfigError("robot.gripper", ..., "is missing: this task grips objects")
        self._robot, self._gripper = RobotModel.load(config), config.gripper
        self._home = np.array(config.named_poses["home"])
        self._known: dict[tuple[float, ...], tuple[list[float], list[float]]] = {}

    def grasp(self, thing: SeenObject) -> Grasp | Left:
        """Return a proved grasp, or why there is none."""
        width = min(thing.size.x, thing.size.y)
        if width + SLACK > self._gripper.max_width:
            return Left(object=thing.id, reason=f"it is {1e3 * width:.0f} mm wide, too wide for the fingers")
        across = thing.yaw + (0.0 if thing.size.y <= thing.size.x else math.pi / 2)
        turn = math.pi / 2 if self._gripper.closing_axis == "x" else 0.0
        z = max(thing.top - DEPTH, thing.bottom + LOWEST)
        yaws = sorted((math.remainder(across + turn + yaw, 2 * math.pi) for yaw in YAWS[::2]), key=abs)
        for yaw in yaws:
            T = tool_down(thing.center.x, thing.center.y, z, yaw)
            found = self._solve(T)
            if found:
                above = T.copy()
                above[2, 3] += APPROACH
                return Grasp(
                    id=f"g_{thing.id}", object=thing.id, pose=matrix_to_pose(T), approach=matrix_to_pose(above),
                    width=width, opening=width + SLACK, score=round(1.0 - 0.02 * len(thing.id), 3), proved=True,
                    q_approach=found[0], q=found[1])
        return Left(object=thing.id, reason="out of reach")

    def _solve(self, T: Array) -> tuple[list[float], list[float]] | None:
        key = tuple(np.round(T[:3], 4).ravel().tolist())
        if key not in self._known:
            above = T.copy()
            above[2, 3] += APPROACH
            q_approach = solve_ik(self._robot, above, self._home)
            q = None if q_approach is None else solve_ik(self._robot, T, q_approach, restarts=0)
            if q_approach is None or q is None:
                return None
            self._known[key] = q_approach.tolist(), q.tolist()
        return self._known[key]


def heap(objects: m.WorldObjects, finder: TopDown, stamp: int) -> Heap:
    """Return what the detector would report at home."""
    things = [seen(each) for each in objects.objects if each.state in ("table", "contained")]
    found = [finder.grasp(each) for each in things if each.place in ("tray", "table")]
    return Heap(
        header=m.Header(stamp=stamp, frame_id="world"), at_home=True, objects=things, scorer="geometric",
        grasps=[each for each in found if isinstance(each, Grasp)],
        left=[each for each in found if isinstance(each, Left)])


async def run(bus: Bus, config: Config) -> None:
    """Publish the heap at the rate; objects only while the arm is at home, as a camera above would see them."""
    truth, joints = bus.reader(topics.SCENE_OBJECTS), bus.reader(topics.JOINT_STATES)
    out, finder = bus.writer(HEAP), TopDown(config.robot)
    home = HomeMonitor(config.robot.named_poses["home"])
    await bus.ready()
    pace = LoopRate(bus, lambda: bus.clock.wall_rate(config.rate, 50.0))

    async def watch_arm() -> None:
        async for state in joints:
            at = dict(zip(state.name, state.position, strict=True))
            if all(name in at for name in config.robot.joints):
                home.add([at[name] for name in config.robot.joints], state.header.stamp)

    async def look() -> None:
        while True:
            objects, stamp = truth.latest, bus.header().stamp
            if objects is not None and home.was_home(stamp):
                out.put(await asyncio.to_thread(heap, objects, finder, stamp))
            elif objects is not None:
                out.put(Heap(header=m.Header(stamp=stamp, frame_id="world"), at_home=False))
            await pace.wait()

    async with asyncio.TaskGroup() as group:
        group.create_task(watch_arm())
        group.create_task(look())


if __name__ == "__main__":
    main(run, Config)
