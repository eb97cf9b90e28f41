"""An intruder that puts a pillar into the path of running motions, removes it, and checks by ground truth."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from common import topics
from common.config import Cell, load_cell
from common.errors import RequestFailed
from common.messages import CollisionObject, FollowedRequest, JointState, MotionStatus, Pose, Vector3, WorldEdit
from common.planning.robot_geometry import RobotGeometry
from common.planning.trajectory import sample, timed_path
from common.robot.finger_joints import measured_width
from common.robot.model import RobotModel
from common.transport.bus import Bus
from tests.harness import running_with, until
from tests.simulated.sees_more import SAID, SEEN
from tests.simulated.visited import SimulatedCell

Array = NDArray[np.float64]

KEEPERS = {"panda": "scene_manager", "ur5": "outline_scene"}
USUAL = {"panda": (), "ur5": ("services.contour_detector.select=Object_0",)}  # a pillar is no work piece
SIDES, HEIGHTS = (0.03, 0.08), (0.15, 0.45)  # [m]
SOONEST, LATEST = 0.4, 2.0  # [s] from when it is put there until the arm would touch it
STEP = 0.04  # [s] between states of a motion that are looked at
SEES_AFTER = 0.1  # [s] that a camera takes, and what finds things in its picture
ABOUT_CONTAINERS = 0.18  # [m] from the middle: what is put there lies in them
TRIES = 20


def watched_cell(name: str, overrides: Sequence[str] = ()) -> Cell:
    """A cell whose scene keeper sees pillars too."""
    cell = load_cell(name, [*USUAL[name], *overrides])
    keeper = cell.services[KEEPERS[name]]
    seeing = keeper.model_copy(update={"module": f"tests.simulated.sees_more.{KEEPERS[name]}"})
    return cell.model_copy(update={"services": {**cell.services, KEEPERS[name]: seeing}})


@dataclass
class Intrusion:
    """A pillar that was put into the way."""

    expected: float  # [s] later the arm would have touched it
    stays: float  # [s] from when the arm is held
    nearest: float = np.inf  # [m] distance of any link to it, by coal
    latency: float = np.inf  # [s] from the scene message to the first set-point that brakes; nan: it was not held
    given_up: bool = False  # the motion, before the pillar was gone


@dataclass
class Intruder:
    """Puts pillars into the way of a cell's motions at random times."""

    seed: int
    most: int
    stays: tuple[float, float] = (0.2, 2.5)  # [s] at random
    found: list[Intrusion] = field(default_factory=list)

    async def visit(self, simulated: SimulatedCell, bus: Bus) -> None:
        """Do so until the task has ended, or so often."""
        SEEN.clear()
        self._rng, self._world = np.random.default_rng(self.seed), simulated.cell.world
        self._robot = RobotModel.load(simulated.cell.robot)
        self._hulls = RobotGeometry(self._robot)
        self._links = self._hulls.geometry
        self._data, self._placed = self._robot.model.createData(), pin.GeometryData(self._links)
        self._bus, self._motion = bus, bus.reader(topics.MOTION_STATUS)
        self._joints = bus.reader(topics.JOINT_STATES)
        self._edit, self._followed = bus.client(topics.WORLD_EDIT), bus.client(topics.MOTION_FOLLOWED)
        self._pillar: tuple[coal.Box, coal.Transform3s, Intrusion] | None = None
        async with running_with(self._check()):
            while len(self.found) < self.most and not simulated.ended.is_set():
                await asyncio.sleep(float(self._rng.uniform(0.3, 3.0)))
                status = self._motion.latest
                if status is not None and status.state == "active" and not status.held:
                    with contextlib.suppress(RequestFailed):  # it may end while it is looked at
                        await self._intrude(status)

    async def _intrude(self, status: MotionStatus) -> None:
        asked = await self._followed.call(FollowedRequest(id=status.id), 1.0)
        timed = timed_path(asked.trajectory)
        now = status.progress * timed.times[-1] + (self._bus.clock.now() - status.header.stamp * 1e-9)
        rest = sample(timed, np.arange(now, timed.times[-1], STEP))
        width = self._width(self._joints.latest)
        for _ in range(TRIES if len(rest) * STEP > SOONEST else 0):
            side, height = float(self._rng.uniform(*SIDES)), float(self._rng.uniform(*HEIGHTS))
            aim = self._robot.fk(rest[self._rng.integers(int(SOONEST / STEP), len(rest))])[:2, 3]
            x, y = (float(v) for v in aim + self._rng.uniform(-0.05, 0.05, 2))
            place = Vector3(x=x, y=y, z=self._ground(x, y) + height / 2)
            box, at = coal.Box(side, side, height), coal.Transform3s(np.eye(3), np.array([x, y, place.z]))
            touches = next((k for k, q in enumerate(rest) if self._distance(q, box, at, width) <= 0.0), None)
            if touches is None or not SOONEST <= touches * STEP <= LATEST or self._in_a_container(x, y):
                continue
            size = Vector3(x=side, y=side, z=height)
            with contextlib.suppress(RequestFailed):  # it cannot stand there
                name = (await self._edit.call(WorldEdit(op="add", shape="box", size=size, position=place, yaw=0.0))).id
                thing = CollisionObject(id=name, role="fixture", shape="box", dimensions=[side, side, height],
                                        pose=Pose(position=place))
                intrusion = Intrusion(touches * STEP, float(self._rng.uniform(*self.stays)))
                self._pillar = box, at, intrusion
                self.found.append(intrusion)
                await self._stand(thing, status.id, intrusion)
                return

    async def _stand(self, pillar: CollisionObject, goal: str, intrusion: Intrusion) -> None:
        """Have it seen, and take it away after a while, unless the motion is given up long before."""
        loop = asyncio.get_running_loop()
        await asyncio.sleep(SEES_AFTER)
        SAID.clear()
        SEEN[pillar.id] = pillar
        braked = await until(
            self._motion, lambda m: "scene_monitor" in m.held_by or m.id != goal or m.state != "active", 5.0)
        said_at = SAID.get((pillar.id,), loop.time())
        said = loop.time() - said_at
        # The task may have been first, as what it was on its way to is hidden by the pillar; or fingers that are closer
        # together than those of the robot file pass it by.
        held = "scene_monitor" in braked.held_by
        intrusion.latency = said - (self._bus.clock.now() - braked.header.stamp * 1e-9) if held else np.nan
        intrusion.given_up = not held and braked.state == "cancelled"
        with contextlib.suppress(TimeoutError):
            await until(self._motion, lambda m: m.id != goal or m.state != "active", intrusion.stays)
            intrusion.given_up = intrusion.given_up or held
        left = intrusion.stays - (loop.time() - said_at)
        await asyncio.sleep(max(left, 0.0))
        self._pillar = None
        await self._edit.call(WorldEdit(op="remove", id=pillar.id))
        await asyncio.sleep(SEES_AFTER)
        SEEN.clear()

    def _ground(self, x: float, y: float) -> float:
        """Return the height of the surface below a pillar [m]."""
        tops = [thing.position[2] + thing.dimensions[2] / 2 for thing in self._world.fixtures if thing.shape == "box"
                and abs(x - thing.position[0]) < thing.dimensions[0] / 2
                and abs(y - thing.position[1]) < thing.dimensions[1] / 2]
        return max(tops, default=self._world.table_height)

    def _in_a_container(self, x: float, y: float) -> bool:
        return any(max(abs(x - box.x), abs(y - box.y)) < ABOUT_CONTAINERS for box in self._world.containers.values())

    async def _check(self) -> None:
        async for state in self._joints:
            q = self._robot.order(state.name, state.position)
            if self._pillar is not None and q is not None:
                box, at, intrusion = self._pillar
                intrusion.nearest = min(intrusion.nearest, self._distance(q, box, at, self._width(state)))

    def _width(self, state: JointState | None) -> float | None:
        """Between the fingers as measured [m]."""
        return None if state is None else measured_width(self._robot.config.gripper, state.name, state.position)

    def _distance(self, q: Array, box: coal.Box, at: coal.Transform3s, width: float | None) -> float:
        """[m] between the nearest link and a pillar, by coal; 0 or less where they touch.

        The fingers are as far apart as measured [m]; None: as the robot file holds them.
        """
        pin.updateGeometryPlacements(self._robot.model, self._data, self._links, self._placed, q)
        for number, T_joint_hull in self._hulls.finger_placements(width):
            self._placed.oMg[number] = self._data.oMi[self._hulls.joints[number]] * T_joint_hull
        nearest = np.inf
        for number, item in enumerate(self._links.geometryObjects):
            if item.parentJoint != 0:
                pose, result = self._placed.oMg[number], coal.DistanceResult()
                where = coal.Transform3s(pose.rotation, pose.translation)
                nearest = min(nearest, coal.distance(item.geometry, where, box, at, coal.DistanceRequest(), result))
        return float(nearest)
