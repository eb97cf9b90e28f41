"""An executor with simulated hardware on a table, driven cycle by cycle by a test."""

import math

import numpy as np

from applications.pick_place.topics import scene_balls
from common.config import Fixture, GripperConfig, World
from common.control.executor import Executor
from common.hardware.mock import MockHardware, SimulatedFingers
from common.messages import ExecuteRequest, GripperCommand, Header
from common.robot.transforms import tool_down
from common.sim.kinematic import KinematicWorld
from common.sim.simulated_cell import SimulatedCell

START = np.zeros(2)
GRIPPER = GripperConfig(joints=["left", "right"], links=[])
TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025))


class Gantry:
    """Kinematics of a gripper over the table; the two joints move it along x and z from (0.5, 0, 0.03)."""

    def fk(self, q):
        return tool_down(0.5 + q[0], 0.0, 0.03 + q[1])


class Saver:
    """Keeps the saved states in a list, the newest last."""

    def __init__(self):
        self.states = []

    def save(self, state):
        self.states.append(state)

    def close(self):
        pass


def mock(start=START, width=0.08):
    return MockHardware(start, SimulatedFingers(GRIPPER, width))


class LateArm(MockHardware):
    """An arm that reaches its set-points so much later [s], and stays where it is when it is stopped."""

    def __init__(self, start, gripper, delay):
        super().__init__(start, gripper)
        self._delay, self._sent = delay, [(-math.inf, start, 0.0 * start)]

    def read(self, now):
        while len(self._sent) > 1 and self._sent[1][0] <= now - self._delay + 1e-6:
            self._sent.pop(0)
        return self._sent[0][1].copy(), self._sent[0][2].copy()

    def write(self, positions, velocities, now):
        self._sent.append((now, positions.copy(), velocities.copy()))

    def stop(self):
        self._sent = [(-math.inf, self._sent[0][1], 0.0 * self._sent[0][2])]


class ExecutorRig:
    """An executor, and all that it has published."""

    def __init__(self, limits, hardware=None, balls=((0.5, 0.0),), world=None, persisted=None):
        self.hardware, self.saver = hardware or mock(), Saver()
        self.world = world or KinematicWorld(World(fixtures=[TABLE], balls=list(balls)))
        self.cell = SimulatedCell(self.world, self.hardware, Gantry(), persisted=persisted, saver=self.saver)
        self.executor = Executor(
            self.hardware, limits, START, gripper=GRIPPER, kinematics=Gantry(), world=self.cell)
        self.stamp = int(1.7e18)
        self.motions, self.grippers, self.updates, self.balls, self.joints = [], [], [], [], []

    @property
    def now(self):
        return self.stamp * 1e-9

    @property
    def saved(self):
        return self.saver.states[-1]

    def step(self, seconds=0.01):
        self.stamp += int(seconds * 1e9)
        report = self.executor.cycle(Header(stamp=self.stamp, frame_id="world"))
        self.motions += [report.motion] if report.motion else []
        self.grippers += [report.gripper] if report.gripper else []
        self.balls += [scene_balls(report.objects)] if report.objects else []
        self.joints += [report.joints] if report.joints else []
        self.updates += [update.data for update in report.updates]
        return report

    def run(self, seconds):
        """Run cycles; return the lines that they logged."""
        return [note for _ in range(round(seconds / 0.01)) for note in self.step().notes]

    def execute(self, goal, trajectory):
        return self.executor.execute(ExecuteRequest(id=goal, trajectory=trajectory), self.now)

    def grip(self, goal, width, **more):
        return self.executor.command_gripper(GripperCommand(id=goal, width=width, **more), self.now)

    def restarted(self, limits, stop=None, hardware=None):
        """An executor after this one, in the same world."""
        again = ExecutorRig(limits, hardware, persisted=self.saved)
        again.stamp = self.stamp
        if stop is not None:
            again.executor.authority.stop(stop, again.now)
        again.executor.restore(again.now)
        return again
