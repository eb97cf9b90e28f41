"""An arm of a cell, its executor, and a clock that advances with each step."""

import numpy as np
import pytest

from common import messages as m
from common.config import load_cell
from common.control.executor import Executor
from common.errors import Refused
from common.hardware.interface import Limits
from common.hardware.mock import MockHardware
from common.robot.model import RobotModel
from common.time_source import SystemTimeSource, use_time_source
from tests.common.control.trajectories import trajectory

PERIOD = 0.01
UR5_BENT = np.array([0.0, -1.9, 1.9, -1.6, -1.57, 0.0])  # its home pose is singular
ROBOTS = {cell: RobotModel.load(load_cell(cell).robot) for cell in ("panda", "ur5")}


class JoggedArm:
    """Jogs, moves and changes owners for the operators ann (by default) and others."""

    def __init__(self, robot):
        self.robot, self.joint, self.stamp = robot, robot.joint_names[0], int(1.7e18)
        self.sent, self.reports, self.refused = [], [], []  # set-points, reports, codes of refused jog commands
        self.limits = Limits(
            tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
            np.array(robot.config.deceleration_limits) if robot.config.deceleration_limits else None, robot.jerk)
        self.source = SystemTimeSource()
        self.source.monotonic_ns = self.source.wall_ns = lambda: self.stamp
        self.restart()
        self.run(0.35)  # after which jog commands are accepted

    def restart(self):
        """Start a new executor where the arm is."""
        home = self.robot.named("home") if self.robot.dof == 7 else UR5_BENT
        q = self.q if self.sent else home
        self.executor = Executor(MockHardware(q.copy(), None), self.limits, q, kinematics=self.robot)
        self.authority = self.executor.authority

    def call(self, function, *args):
        with use_time_source(self.source):
            return function(*args)

    def step(self, seconds=PERIOD):
        self.stamp += int(seconds * 1e9)
        self.reports.append(self.call(self.executor.cycle, m.Header(stamp=self.stamp)))
        self.sent.append((self.stamp * 1e-9, self.executor.arm.set_point.copy()))

    def run(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def command(self, **fields):
        self.call(self.executor.jog, m.JogCommand(**{"owner": "ann", **fields}))

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
        self.jog(seconds, joints={self.joint: velocity}, **fields)

    def jog_joints(self, seconds, velocities):
        self.jog(seconds, joints=dict(zip(self.robot.joint_names, velocities, strict=True)))

    def jog_tool(self, seconds, linear=(0, 0, 0), angular=(0, 0, 0), **fields):
        linear, angular = (m.Vector3(x=x, y=y, z=z) for x, y, z in (linear, angular))
        self.jog(seconds, linear=linear, angular=angular, **fields)

    def own(self, act="take", owner="ann", **more):
        return self.call(self.authority.own, m.OwnRequest(act=act, owner=owner, **more), self.stamp * 1e-9)

    def stop(self, owner):
        return self.call(self.authority.stop, m.StopRequest(owner=owner), self.stamp * 1e-9)

    def hold(self, owner, hold=True, **more):
        return self.call(self.authority.hold, m.HoldRequest(hold=hold, owner=owner, **more), self.stamp * 1e-9)[0]

    def start_task(self, owner, **more):
        """Release stops and holds, as a start of the task does."""
        more.setdefault("acknowledged", self.authority.interlocks.record.newest)
        return self.hold(owner, hold=False, stops=True, **more)

    def execute(self, goal, owner="", **more):
        message = trajectory([(0.0, self.q), (2.0, self.q + 0.2)], self.robot.joint_names)
        request = m.ExecuteRequest(id=goal, owner=owner, trajectory=message, **more)
        return self.call(self.executor.execute, request, self.stamp * 1e-9)

    @property
    def q(self):
        return self.sent[-1][1]

    @property
    def tcp(self):
        return self.robot.fk(self.q)

    @property
    def positions(self):
        """All positions of the tool so far."""
        return np.array([self.robot.fk(q)[:3, 3] for _, q in self.sent])

    @property
    def owner(self):
        return self.authority.owner.owner, self.authority.owner.kind

    def at_rest(self, seconds=0.3):
        before = self.q
        self.run(seconds)
        return np.array_equal(before, self.q)

    def assert_within_limits(self):
        """Check velocity, acceleration and jerk between set-points."""
        q, limits = np.array([q for _, q in self.sent]), self.limits
        for n, limit, most in ((1, limits.velocity, 1.0), (2, limits.braking, 1.001), (3, limits.jerks, 1.001)):
            assert (np.abs(np.diff(q, n, axis=0) / PERIOD**n) / limit).max() <= most

    def tool_speed(self):
        """Return the largest speed of the tool so far."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).max()) / PERIOD


@pytest.fixture(params=ROBOTS)
def arm(request):
    return JoggedArm(ROBOTS[request.param])


@pytest.fixture
def ur5():
    return JoggedArm(ROBOTS["ur5"])
