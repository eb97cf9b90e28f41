"""An arm of a cell, its executor, and a clock that advances with each step."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from common.config import load_cell
from common.control.executor import Executor
from common.errors import Refused
from common.hardware.interface import Limits
from common.hardware.mock import MockHardware
from common.messages import (
    ExecuteRequest,
    Header,
    HoldRequest,
    JogCommand,
    JointTrajectory,
    JointTrajectoryPoint,
    OwnRequest,
    StopRequest,
    Vector3,
)
from common.robot.model import RobotModel
from common.time_source import SystemTimeSource, use_time_source

PERIOD = 0.01
UR5_BENT = np.array([0.0, -1.9, 1.9, -1.6, -1.57, 0.0])  # its home pose is singular
ROBOTS = {cell: RobotModel.load(load_cell(cell).robot) for cell in ("panda", "ur5")}


@dataclass
class JoggedArm:
    """Jogs, moves and changes owners for the operators ann (by default) and others."""

    robot: RobotModel
    stamp: int = int(1.7e18)
    sent: list = field(default_factory=list)
    reports: list = field(default_factory=list)
    refused: list = field(default_factory=list)  # codes of refused jog commands

    def __post_init__(self):
        robot, self.home = self.robot, self.robot.named("home") if self.robot.dof == 7 else UR5_BENT
        self.limits = Limits(
            tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
            np.array(robot.config.deceleration_limits) if robot.config.deceleration_limits else None, robot.jerk)
        self.source = SystemTimeSource()
        self.source.monotonic_ns = self.source.wall_ns = lambda: self.stamp
        self.restart()
        self.run(0.35)  # after which jog commands are accepted

    def restart(self):
        """Start a new executor where the arm is."""
        q = self.q if self.sent else self.home
        self.executor = Executor(MockHardware(q.copy(), None), self.limits, q, kinematics=self.robot)
        self.authority = self.executor.authority

    def call(self, function, *args):
        with use_time_source(self.source):
            return function(*args)

    def step(self, seconds=PERIOD):
        self.stamp += int(seconds * 1e9)
        self.reports.append(self.call(self.executor.cycle, Header(stamp=self.stamp)))
        self.sent.append((self.stamp * 1e-9, self.executor.arm.set_point.copy()))

    def run(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def command(self, **fields):
        self.call(self.executor.jog, JogCommand(**{"owner": "ann", **fields}))

    def jog(self, seconds, **fields):
        """Send a command every 20 ms."""
        for k in range(round(seconds / PERIOD)):
            if k % 2 == 0:
                try:
                    self.command(**fields)
                except Refused as refusal:
                    self.refused.append(refusal.code)
            self.step()

    def jog_joint(self, seconds, velocity=0.2, **fields):
        self.jog(seconds, joints={self.robot.joint_names[0]: velocity}, **fields)

    def jog_tool(self, seconds, linear=(0, 0, 0), angular=(0, 0, 0), **fields):
        vectors = (Vector3(x=x, y=y, z=z) for x, y, z in (linear, angular))
        self.jog(seconds, **dict(zip(("linear", "angular"), vectors, strict=True)), **fields)

    def own(self, act="take", owner="ann", **more):
        return self.call(self.authority.own, OwnRequest(act=act, owner=owner, **more), self.stamp * 1e-9)

    def stop(self, owner):
        return self.call(self.authority.stop, StopRequest(owner=owner), self.stamp * 1e-9)

    def hold(self, owner, hold=True, **more):
        return self.call(self.authority.hold, HoldRequest(hold=hold, owner=owner, **more), self.stamp * 1e-9)[0]

    def start_task(self, owner, **more):
        """Release stops and holds, as a start of the task does."""
        return self.hold(owner, hold=False, stops=True, **more)

    def execute(self, goal, owner="", **more):
        start = self.q
        points = [JointTrajectoryPoint(time_from_start=t, positions=list(start + step), velocities=[0.0] * len(start),
                                       accelerations=[0.0] * len(start)) for t, step in ((0.0, 0.0), (2.0, 0.2))]
        request = ExecuteRequest(id=goal, owner=owner, trajectory=JointTrajectory(
            joint_names=self.robot.joint_names, points=points), **more)
        return self.call(self.executor.execute, request, self.stamp * 1e-9)

    @property
    def q(self):
        return self.sent[-1][1]

    @property
    def tcp(self):
        return self.robot.fk(self.q)

    @property
    def owner(self):
        return self.authority.owner.owner, self.authority.owner.kind

    def at_rest(self, seconds=0.3):
        before = self.q
        self.run(seconds)
        return np.array_equal(before, self.q)

    def limit_shares(self):
        """Largest shares of velocity, acceleration and jerk limits between set-points."""
        q = np.array([q for _, q in self.sent])
        v, limits = np.diff(q, axis=0) / PERIOD, self.limits
        a = np.diff(v, axis=0) / PERIOD
        j = np.diff(a, axis=0) / PERIOD
        return (float((np.abs(v) / limits.velocity).max()), float((np.abs(a) / limits.braking).max()),
                float((np.abs(j) / limits.jerks).max()))

    def assert_within_limits(self):
        velocity, acceleration, jerk = self.limit_shares()
        assert velocity <= 1.0 and acceleration <= 1.001 and jerk <= 1.001

    def tool_speeds(self):
        positions = np.array([self.robot.fk(q)[:3, 3] for _, q in self.sent])
        return np.linalg.norm(np.diff(positions, axis=0), axis=1) / PERIOD


@pytest.fixture(params=ROBOTS)
def arm(request):
    return JoggedArm(ROBOTS[request.param])
