"""Mock hardware: an arm that is at once where it is commanded, and simulated fingers."""

from __future__ import annotations

import ruckig

from common.config import GripperConfig, Parameters, RobotConfig
from common.hardware.interface import GripperReading, Limits, Vector

simulated = True
SAME_WIDTH = 1e-9  # [m] widths that differ by less are equal


class Options(Parameters):
    """None: a perfect arm has no parameters."""


class GripperOptions(Parameters):
    """None: the gripper section of the robot file has all parameters."""


class MockHardware:
    """An arm that reports its newest set-points."""

    def __init__(self, start: Vector, gripper: SimulatedFingers | None) -> None:
        """Start at rest at `start` (dof,) [rad]."""
        self.gripper = gripper
        self._positions = start.copy()
        self._velocities = 0.0 * start

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Return the newest set-points (dof,) [rad], [rad/s]."""
        return self._positions.copy(), self._velocities.copy()

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Store the set-points."""
        self._positions, self._velocities = positions.copy(), velocities.copy()

    def close(self) -> None:
        """Do nothing: there is no device."""


class SimulatedFingers:
    """A gripper whose width follows a jerk-limited motion and stops at an obstruction; also the valve of a suction cup.

    While an object blocks the fingers they press; without it they close to the commanded width.

    Attributes:
        no_seal: why a cup holds nothing, reported by its readings.
    """

    def __init__(self, config: GripperConfig, width: float | None = None) -> None:
        """Start at rest at a width [m]; fully open without one."""
        self._config = config
        self._width, self._velocity, self._acceleration = config.max_width if width is None else width, 0.0, 0.0
        self._target = self._width
        self._effort = config.max_effort
        self._obstruction, self.no_seal = 0.0, ""
        self._blocked = False
        self._start_time = 0.0
        self._motion: ruckig.Trajectory | None = None
        self._now = 0.0

    def command(self, width: float, now: float, effort: float | None = None) -> None:
        """Start to move from the present width, velocity and acceleration to rest at a width [m].

        Blocked fingers press with an effort [N], by default with the largest.
        """
        self._advance(now)
        self._effort = self._config.max_effort if effort is None else effort
        self._target = min(max(width, 0.0), self._config.max_width)
        self._start(now)

    def obstruct(self, width: float) -> None:
        """Let the fingers close no further than a width [m]; 0 when nothing is between them."""
        freed = self._blocked and width < self._width - SAME_WIDTH
        self._obstruction = width
        if freed:
            self._blocked = False
            self._start(self._now)
        elif self._config.cup is not None and self._motion is None and self._target < width - SAME_WIDTH:
            self._width, self._blocked = width, True  # a cup under suction takes what it touches

    def place(self, width: float) -> None:
        """Set the fingers at rest at a width [m]."""
        self._width = self._target = min(max(width, 0.0), self._config.max_width)
        self._velocity = self._acceleration = 0.0
        self._motion, self._blocked = None, False

    def read(self, now: float) -> GripperReading:
        """Return width [m], its rate [m/s], whether the fingers move, whether they press, and with what effort [N]."""
        self._advance(now)
        effort = self._effort if self._blocked else 0.0
        return GripperReading(self._width, self._velocity, self._motion is not None, self._blocked, effort,
                              "" if self._blocked else self.no_seal)

    def _start(self, now: float) -> None:
        self._blocked = False
        self._motion, self._start_time = self._plan(), now
        self._advance(now)

    def _advance(self, now: float) -> None:
        self._now = now
        if self._motion is None:
            return
        elapsed = now - self._start_time
        if elapsed >= self._motion.duration:
            self._width, self._velocity, self._acceleration = self._target, 0.0, 0.0
            self._motion = None
        else:
            (self._width,), (self._velocity,), (self._acceleration,) = self._motion.at_time(max(elapsed, 0.0))
            self._width = min(max(self._width, 0.0), self._config.max_width)
        if self._target < self._obstruction - SAME_WIDTH and self._width <= self._obstruction + SAME_WIDTH:
            self._width, self._velocity, self._acceleration = self._obstruction, 0.0, 0.0
            self._motion, self._blocked = None, True

    def _plan(self) -> ruckig.Trajectory:
        problem = ruckig.InputParameter(1)
        problem.current_position, problem.current_velocity = [self._width], [self._velocity]
        problem.current_acceleration = [self._acceleration]
        problem.target_position = [self._target]
        problem.max_velocity, problem.max_acceleration = [self._config.speed], [self._config.acceleration]
        problem.max_jerk = [self._config.jerk]
        motion = ruckig.Trajectory(1)
        result = ruckig.Ruckig(1).calculate(problem, motion)
        if result not in (ruckig.Result.Working, ruckig.Result.Finished):
            raise RuntimeError(f"ruckig finds no finger motion from {problem.current_position} to "
                               f"{problem.target_position}: {result}")
        return motion


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> MockHardware:
    """Create the arm at `start` with open fingers."""
    return MockHardware(start, simulated_fingers(robot))


def create_gripper(gripper: GripperConfig, options: GripperOptions) -> SimulatedFingers:
    """Create open fingers, for an arm of another backend."""
    return SimulatedFingers(gripper)


def simulated_fingers(robot: RobotConfig) -> SimulatedFingers | None:
    """Create open fingers for a robot that has a gripper."""
    return SimulatedFingers(robot.gripper) if robot.gripper else None
