"""The executor in process, and a client that reads its topics and sends requests."""

import asyncio
import threading
from contextlib import asynccontextmanager

import numpy as np
import ruckig

from applications.pick_place.topics import SCENE_BALLS
from common import messages as m
from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.robot.model import RobotModel
from services import trajectory_executor
from services.trajectory_executor import Config
from tests.services.fake_cell import PATIENCE, FakeCell, latest

NAME = "trajectory_executor"
SPEED = 10.0
NOT_TOO_LATE = "services.trajectory_executor.request_timeout=60"  # for a busy machine
SLOW = 0.02  # share of the limits of a motion that a test interrupts
PANDA = load_cell("panda")
ROBOT = RobotModel.load(PANDA.robot)
HOME = ROBOT.named("home")


def config(*overrides: str, **cell) -> Config:
    return service_config(load_cell("panda", [NOT_TOO_LATE, *overrides], **cell), NAME, Config)


class ExecutorClient(FakeCell):
    """A client of the executor."""

    def __init__(self, clock: Clock, net=None, config: Config | None = None) -> None:
        super().__init__(clock, net)
        self.config = config
        self.joints, self.objects = self.reader(topics.JOINT_STATES), self.reader(topics.SCENE_OBJECTS)
        self.motion, self.gripper = self.reader(topics.MOTION_STATUS), self.reader(topics.GRIPPER_STATE)
        self.balls, self.updates = self.reader(SCENE_BALLS), self.reader(topics.SCENE_OBJECT_UPDATES)
        self.execute, self.own = self.client(topics.MOTION_EXECUTE), self.client(topics.MOTION_OWN)
        self.stop, self.hold = self.client(topics.MOTION_STOP), self.client(topics.MOTION_HOLD)
        self.command, self.world = self.client(topics.GRIPPER_COMMAND), self.client(topics.WORLD_EDIT)

    def request(self, goal, trajectory, stamp=None):
        header = self.bus.header() if stamp is None else m.Header(stamp=stamp)
        return m.ExecuteRequest(header=header, id=goal, trajectory=trajectory)

    async def start(self, goal, trajectory, stamp=None):
        return await self.execute.call(self.request(goal, trajectory, stamp), timeout=60)

    async def ended(self, goal):
        return await latest(self.motion, lambda m: m.id == goal and m.state not in ("active", "rejected"))

    async def follow(self, goal, trajectory):
        """Follow a trajectory to its successful end and return the status."""
        answer = await self.start(goal, trajectory)
        assert answer.state == "active", answer.message
        status = await self.ended(goal)
        assert status.state == "succeeded", status.message
        return status

    async def joints_after(self, stamp):
        return await latest(self.joints, lambda state: state.header.stamp > stamp)

    async def move_slowly(self, goal="a", until=0.1, distance=0.25):
        """Start a long motion from home; return when it is under way."""
        await self.start(goal, to_home_plus(distance, scaling=SLOW))
        await latest(self.motion, lambda m: m.progress > until)

    async def grip(self, goal, width):
        await self.command.call(m.GripperCommand(id=goal, width=width))
        return await latest(self.gripper, lambda g: g.id == goal and g.state != "active" and not g.moving)

    async def release(self, owner, **more):
        if more.get("stops"):
            more["acknowledged"] = (await latest(self.motion)).newest
        return await self.hold.call(m.HoldRequest(hold=False, owner=owner, **more))

    async def edit(self, timeout=20.0, **edit):
        return await self.world.call(m.WorldEdit(**edit), timeout=timeout)


@asynccontextmanager
async def executor(*overrides: str, speed: float = SPEED, clock: Clock | None = None, net=None, **cell):
    args = config(*overrides, **cell)
    client = ExecutorClient(clock or Clock(speed), net, args)
    async with client.running(trajectory_executor, args):
        yield client


def move(robot: RobotModel, start, end, scaling=0.5) -> m.JointTrajectory:
    """Return a point-to-point motion at a share of the robot's limits."""
    problem = ruckig.InputParameter(robot.dof)
    problem.current_position, problem.target_position = list(start), list(end)
    problem.max_velocity = list(robot.velocity * scaling)
    problem.max_acceleration = list(robot.acceleration * scaling)
    problem.max_jerk = list(robot.jerk * scaling)
    found = ruckig.Trajectory(robot.dof)
    ruckig.Ruckig(robot.dof).calculate(problem, found)
    points = []
    for t in np.linspace(0.0, found.duration, max(2, round(found.duration / 0.02))):
        q, dq, ddq = found.at_time(float(t))
        points.append(m.JointTrajectoryPoint(time_from_start=float(t), positions=q, velocities=dq, accelerations=ddq))
    return m.JointTrajectory(joint_names=robot.joint_names, points=points)


def to_home_plus(distance: float, start: float = 0.0, scaling: float = 0.5) -> m.JointTrajectory:
    """Return a motion of all Panda joints between offsets [rad] from home."""
    return move(ROBOT, HOME + start, HOME + distance, scaling)


@asynccontextmanager
async def blocked(monkeypatch, where, name: str):
    """Let a method block until the end of the block; yield an event that is set once it was called."""
    loop, entered, resume = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
    method = getattr(where, name)

    def wait(*args, **kwargs):
        loop.call_soon_threadsafe(entered.set)
        assert resume.wait(PATIENCE)
        return method(*args, **kwargs)

    monkeypatch.setattr(where, name, wait)
    try:
        yield entered
    finally:
        resume.set()


async def cycles_continue(client: ExecutorClient, cycles: int = 20) -> None:
    """Return when so many more joint states have arrived."""
    async with asyncio.timeout(PATIENCE):
        stamps = {(await client.joints.next()).header.stamp for _ in range(cycles)}
    assert len(stamps) == cycles
