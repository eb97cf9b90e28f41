"""Replacement of the perception in simulations: objects and one grasp of each from the simulated truth, no images."""

from __future__ import annotations

import asyncio
import math
from itertools import product

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from applications.sorting.topics import HEAP, GraspCandidate, Heap, Left, SeenObject
from common import messages as m
from common import topics
from common.config import Parameters, RobotConfig, Surroundings, Tunable
from common.errors import ConfigError
from common.planning.ik import solve_ik
from common.process.service import main
from common.process.timing import LoopRate
from common.robot.home import HOME_TOLERANCE
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_pose, pose_to_matrix, tool_down
from common.transport.bus import Bus

Array = npt.NDArray[np.float64]

APPROACH = 0.10  # [m]
DEPTH = 0.03  # [m] of the finger tips below the top
LOWEST = 0.014  # [m] of the finger tips above the support
SLACK = 0.02  # [m] by which the fingers open wider than an object
CLEAR = 0.08  # [m] from the tool to the tray: the arm does not hide it then
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
    """Return an object as it would be seen from above."""
    corners, low, high = _extent(thing)
    (x, y), (length, width), angle = cv2.minAreaRect(corners.astype(np.float32))
    yaw = math.radians(angle)
    if length < width:
        length, width, yaw = width, length, yaw + math.pi / 2
    c = thing.color
    name = min(NAMES, key=lambda each: math.dist(NAMES[each], (c.r, c.g, c.b)))
    shape = {"sphere": "round", "cylinder": "round", "ring": "ring", "box": "box"}.get(thing.shape, "other")
    return SeenObject(
        id=thing.id, place=thing.container or "table", center=m.Vector3(x=x, y=y, z=high),
        size=m.Vector3(x=length, y=width, z=high - low), yaw=math.remainder(yaw, math.pi),
        outline=[(float(u), float(v)) for u, v in corners[:64]], top=high, bottom=low,
        volume=length * width * (high - low) / 2, color=thing.color, color_name=name, shape=shape)


def _extent(thing: m.WorldObject) -> tuple[Array, float, float]:
    """Return the convex outline (n, 2) from above, z of the lowest and of the highest point [m], in world."""
    T = pose_to_matrix(thing.pose)
    if thing.vertices:
        points = np.array(thing.vertices) @ T[:3, :3].T + T[:3, 3]
    elif thing.outline:
        flat = np.array(thing.outline, float)
        points = np.concatenate([np.c_[flat, np.full(len(flat), z)] for z in (thing.base, thing.base + thing.height)])
    else:
        half = np.array([thing.size.x, thing.size.y, thing.size.z]) / 2
        points = np.array(list(product((-1.0, 1.0), repeat=3))) * half @ T[:3, :3].T + T[:3, 3]
    hull = cv2.convexHull(points[:, :2].astype(np.float32))[:, 0].astype(float)
    return hull, float(points[:, 2].min()), float(points[:, 2].max())


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

    def grasp(self, thing: SeenObject) -> GraspCandidate | Left:
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
                return GraspCandidate(
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
        grasps=[each for each in found if isinstance(each, GraspCandidate)],
        left=[each for each in found if isinstance(each, Left)])


async def run(bus: Bus, config: Config) -> None:
    """Publish the heap at the rate; objects only while the arm hides nothing of the tray from above."""
    truth, joints = bus.reader(topics.SCENE_OBJECTS), bus.reader(topics.JOINT_STATES)
    out, finder = bus.writer(HEAP), TopDown(config.robot)
    home = np.array(config.robot.named_poses["home"])
    robot, box = RobotModel.load(config.robot), config.world.containers[config.tray]
    await bus.ready()
    pace = LoopRate(bus, lambda: bus.clock.wall_rate(config.rate, 50.0))

    def is_clear() -> bool:
        """Return whether the tool is next to the tray, or above all that the arm could hide."""
        state = joints.latest
        q = robot.order(state.name, state.position) if state is not None else None
        if q is None:
            return False
        y = float(robot.fk(q)[1, 3])
        return bool(np.abs(q - home).max() < HOME_TOLERANCE) or abs(y - box.y) > box.half_side + CLEAR

    while True:
        objects, stamp = truth.latest, bus.header().stamp
        if objects is not None and is_clear():
            out.put(await asyncio.to_thread(heap, objects, finder, stamp))
        elif objects is not None:
            out.put(Heap(header=m.Header(stamp=stamp, frame_id="world"), at_home=False))
        await pace.wait()


if __name__ == "__main__":
    main(run, Config)
