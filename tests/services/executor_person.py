"""The executor in process, and a person outside who sees and asks."""

import asyncio
import threading
from contextlib import asynccontextmanager

import numpy as np
import ruckig

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.clock import Clock
from common.config import load_cell, service_config
from common.messages import (
    ExecuteRequest,
    GripperCommand,
    JointTrajectory,
    JointTrajectoryPoint,
)
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.transport.local import LocalNetwork
from services import trajectory_executor
from services.trajectory_executor import Config

CELL = "test"
SPEED = 10.0
PATIENT = "services.trajectory_executor.request_timeout=60"  # a busy machine is no reason to refuse


def config(*overrides: str) -> Config:
    return service_config(load_cell("panda", [PATIENT, *overrides]), "trajectory_executor", Config)


class Person:
    """Somebody outside who sees and asks."""

    def __init__(self, net: LocalNetwork, clock: Clock) -> None:
        self.bus = net.bus("tester", cell=CELL, clock=clock)
        self.joints = self.bus.reader(topics.JOINT_STATES)
        self.motion = self.bus.reader(topics.MOTION_STATUS)
        self.gripper = self.bus.reader(topics.GRIPPER_STATE)
        self.balls = self.bus.reader(SCENE_BALLS)
        self.updates = self.bus.reader(topics.SCENE_OBJECT_UPDATES)
        self.execute = self.bus.client(topics.MOTION_EXECUTE)
        self.stop = self.bus.client(topics.MOTION_STOP)
        self.hold = self.bus.client(topics.MOTION_HOLD)
        self.command = self.bus.client(topics.GRIPPER_COMMAND)
        self.edit = self.bus.client(topics.WORLD_EDIT)

    async def see(self, reader, test):
        """The first message for which test is true."""
        async with asyncio.timeout(20):
            message = reader.latest
            while message is None or not test(message):
                message = await reader.next()
            return message

    def asks(self, **fields):
        return ExecuteRequest(header=self.bus.header(), **fields)

    async def follow(self, goal, trajectory):
        answer = await self.execute.call(self.asks(id=goal, trajectory=trajectory))
        assert answer.state == "active", answer.message
        return await self.see(self.motion, lambda m: m.id == goal and m.state != "active")

    async def grip(self, goal, width):
        await self.command.call(GripperCommand(id=goal, width=width))
        return await self.see(self.gripper, lambda g: g.id == goal and g.state != "active" and not g.moving)


@asynccontextmanager
async def executor(*overrides: str, speed: float = SPEED):
    net, clock = LocalNetwork(), Clock(speed)
    given = config(*overrides)
    async with running_service(net, trajectory_executor.run, given, name="trajectory_executor", cell=CELL, clock=clock):
        yield Person(net, clock)


def move(robot: RobotModel, start, end, scaling=0.5) -> JointTrajectory:
    """A point-to-point motion within the robot's limits."""
    asked = ruckig.InputParameter(robot.dof)
    asked.current_position, asked.target_position = list(start), list(end)
    asked.max_velocity = list(robot.velocity * scaling)
    asked.max_acceleration = list(robot.acceleration * scaling)
    asked.max_jerk = list(robot.jerk * scaling)
    found = ruckig.Trajectory(robot.dof)
    ruckig.Ruckig(robot.dof).calculate(asked, found)
    points = []
    for t in np.linspace(0.0, found.duration, max(2, round(found.duration / 0.02))):
        q, dq, ddq = found.at_time(float(t))
        points.append(JointTrajectoryPoint(time_from_start=float(t), positions=q, velocities=dq, accelerations=ddq))
    return JointTrajectory(joint_names=robot.joint_names, points=points)


@asynccontextmanager
async def blocked(monkeypatch, where, name: str):
    """A method that takes as long as the block does; yields an event that is set once it was called."""
    loop, entered, go_on = asyncio.get_running_loop(), asyncio.Event(), threading.Event()
    method = getattr(where, name)

    def wait(*arguments, **named):
        loop.call_soon_threadsafe(entered.set)
        assert go_on.wait(20)
        return method(*arguments, **named)

    monkeypatch.setattr(where, name, wait)
    try:
        yield entered
    finally:
        go_on.set()


async def goes_on(person: Person, cycles: int = 20) -> None:
    """Return when so many more joint states were taken."""
    async with asyncio.timeout(20):
        stamps = {(await person.joints.next()).header.stamp for _ in range(cycles)}
    assert len(stamps) == cycles
