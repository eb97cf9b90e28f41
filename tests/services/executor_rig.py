"""The executor in process, and a client that reads its topics and sends requests."""

import asyncio
import threading
from contextlib import asynccontextmanager

import numpy as np
import ruckig

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.messages import ExecuteRequest, GripperCommand, HoldRequest, JointTrajectory, JointTrajectoryPoint
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.transport.local import LocalNetwork
from services import trajectory_executor
from services.trajectory_executor import Config

CELL, NAME = "test", "trajectory_executor"
SPEED = 10.0
NOT_TOO_LATE = "services.trajectory_executor.request_timeout=60"  # for a busy machine
SLOW = 0.02  # share of the limits of a motion that a test interrupts


def config(*overrides: str) -> Config:
    return service_config(load_cell("panda", [NOT_TOO_LATE, *overrides]), NAME, Config)


class ExecutorClient:
    """A client of the executor."""

    def __init__(self, net: LocalNetwork, clock: Clock, config: Config | None = None) -> None:
        self.net, self.config = net, config
        self.bus = net.bus("tester", cell=CELL, clock=clock)
        self.joints = self.bus.reader(topics.JOINT_STATES)
        self.motion = self.bus.reader(topics.MOTION_STATUS)
        self.gripper = self.bus.reader(topics.GRIPPER_STATE)
        self.balls = self.bus.reader(SCENE_BALLS)
        self.updates = self.bus.reader(topics.SCENE_OBJECT_UPDATES)
        self.execute = self.bus.client(topics.MOTION_EXECUTE)
        self.stop = self.bus.client(topics.MOTION_STOP)
        self.hold = self.bus.client(topics.MOTION_HOLD)
        self.own = self.bus.client(topics.MOTION_OWN)
        self.command = self.bus.client(topics.GRIPPER_COMMAND)
        self.edit = self.bus.client(topics.WORLD_EDIT)

    async def wait_for(self, reader, test=lambda message: True):
        """Return the first message that passes the test."""
        async with asyncio.timeout(20):
            message = reader.latest
            while message is None or not test(message):
                message = await reader.next()
            return message

    def request(self, goal, trajectory):
        return ExecuteRequest(header=self.bus.header(), id=goal, trajectory=trajectory)

    async def start(self, goal, trajectory):
        return await self.execute.call(self.request(goal, trajectory))

    async def ended(self, goal):
        return await self.wait_for(self.motion, lambda m: m.id == goal and m.state not in ("active", "rejected"))

    async def follow(self, goal, trajectory):
        """Follow a trajectory to its end and return the status."""
        answer = await self.start(goal, trajectory)
        assert answer.state == "active", answer.message
        return await self.ended(goal)

    async def move_slowly(self, robot, goal="a", until=0.2, distance=0.5):
        """Start a long motion from home; return when it is under way."""
        home = robot.named("home")
        await self.start(goal, move(robot, home, home + distance, SLOW))
        await self.wait_for(self.motion, lambda m: m.progress > until)

    async def grip(self, goal, width):
        await self.command.call(GripperCommand(id=goal, width=width))
        return await self.wait_for(self.gripper, lambda g: g.id == goal and g.state != "active" and not g.moving)

    async def release(self, owner, **more):
        return await self.hold.call(HoldRequest(hold=False, owner=owner, **more))


@asynccontextmanager
async def executor(*overrides: str, speed: float = SPEED, clock: Clock | None = None):
    net, clock, args = LocalNetwork(), clock or Clock(speed), config(*overrides)
    async with running_service(net, trajectory_executor.run, args, name=NAME, cell=CELL, clock=clock):
        yield ExecutorClient(net, clock, args)


def move(robot: RobotModel, start, end, scaling=0.5) -> JointTrajectory:
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
        points.append(JointTrajectoryPoint(time_from_start=float(t), positions=q, velocities=dq, accelerations=ddq))
    return JointTrajectory(joint_names=robot.joint_names, points=points)


@asynccontextmanager
async def blocked(monkeypatch, where, name: str):
    """Let a method block until the end of the block; yield an event that is set once it was called."""
    loop, entered, resume = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
    method = getattr(where, name)

    def wait(*args, **kwargs):
        loop.call_soon_threadsafe(entered.set)
        assert resume.wait(20)
        return method(*args, **kwargs)

    monkeypatch.setattr(where, name, wait)
    try:
        yield entered
    finally:
        resume.set()


async def cycles_continue(client: ExecutorClient, cycles: int = 20) -> None:
    """Return when so many more joint states have arrived."""
    async with asyncio.timeout(20):
        stamps = {(await client.joints.next()).header.stamp for _ in range(cycles)}
    assert len(stamps) == cycles
