"""A controller on some hardware, driven by hand."""

import numpy as np

from common.control.trajectory import Tolerances
from common.control.trajectory_controller import TrajectoryController
from common.hardware.mock import MockHardware

START = np.zeros(2)
STEP = 0.01
T0 = 1.7e9


class Rig:
    """A controller on some hardware, and a clock that is moved by hand."""

    def __init__(self, limits, hardware=None, **tolerances):
        self.hardware = hardware or MockHardware(START, None)
        self.controller = TrajectoryController(limits, START, Tolerances(**tolerances))
        self.now = T0
        self.positions, self.velocities = [START], [START]

    def accept(self, goal, trajectory):
        return self.controller.accept(goal, trajectory, self.now, self.hardware.read(self.now)[0])

    def step(self, seconds=STEP):
        self.now += seconds
        q, dq = self.hardware.read(self.now)
        set_points = self.controller.update(self.now, q, dq)
        if set_points is None:
            return self.controller.status
        set_point, velocity = set_points
        self.hardware.write(set_point, velocity, self.now)
        self.positions.append(set_point)
        self.velocities.append(velocity)
        return self.controller.status

    def run(self, cycles):
        for _ in range(cycles):
            self.step()
        return self.controller.status

    def until_over(self, most=20.0):
        end = self.now + most
        while self.controller.status.state == "active":
            assert self.now < end
            self.step()
        return self.controller.status

    @property
    def q(self):
        return self.hardware.read(self.now)[0]
