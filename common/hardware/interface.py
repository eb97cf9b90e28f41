"""The seam between the controller and whatever moves the joints: small, so that a real arm fits behind it.

Times are cell time [s], passed in; a backend keeps no clock of its own. A backend is a module (of this folder, or a
dotted one of the user's own) with

    simulated: bool          # whether the simulated world goes with it; or a function of the options that says so
    class Options(Parameters)
    def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> Hardware

where `start` is the pose at which a simulated arm begins; a real arm is where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from common.errors import ZencellError
from common.messages import RobotMode

Vector = NDArray[np.float64]


class HardwareFault(ZencellError):
    """Raised by a backend when it cannot read or move: ends the goal, and new ones are rejected until it is gone.

    What else a backend raises is taken for one; it is told with its type then.
    """


@dataclass(frozen=True)
class Limits:
    """What the joints can do, in the order of `names`; arrays are (dof,) in [rad], [rad/s], [rad/s^2], [rad/s^3].

    `deceleration` is what they can do in addition when they are braked for a hold or a stop. `jerk` holds for what the
    controller adds to a trajectory; without it they reach their acceleration within 10 ms.
    """

    names: tuple[str, ...]
    lower: Vector
    upper: Vector
    velocity: Vector
    acceleration: Vector
    deceleration: Vector | None = None
    jerk: Vector | None = None

    @cached_property
    def jerks(self) -> Vector:
        """Largest change of acceleration (dof,) [rad/s^3]."""
        return 100.0 * self.acceleration if self.jerk is None else self.jerk

    @cached_property
    def braking(self) -> Vector:
        """Largest change of velocity for a hold or a stop (dof,) [rad/s^2]."""
        return self.acceleration if self.deceleration is None else np.maximum(self.acceleration, self.deceleration)


class ArmState(NamedTuple):
    """What the arm says of itself: positions [rad], velocities [rad/s], and whether it could be moved.

    `speed` is the share at which its own slider lets it move; `message` says why it cannot be moved; all of it is `age`
    [s] old.
    """

    q: list[float]
    dq: list[float]
    mode: RobotMode
    message: str = ""
    speed: float = 1.0
    inputs: int = 0
    outputs: int = 0
    age: float = 0.0


class GripperReading(NamedTuple):
    """State of the fingers: `width` between their inner faces [m], its rate [m/s], `effort` they press with [N]."""

    width: float
    velocity: float
    moving: bool
    holding: bool
    effort: float = 0.0


class Gripper(Protocol):
    """Two fingers that open and close."""

    def command(self, width: float, now: float, effort: float) -> None:
        """Start to move the fingers to a width [m], pressing with an effort [N]; replaces a motion under way."""

    def read(self, now: float) -> GripperReading:
        """State of the fingers at a time that does not go back."""


@runtime_checkable
class PlacedGripper(Gripper, Protocol):
    """Simulated fingers."""

    def place(self, width: float) -> None:
        """Be at rest at a width [m]: where the fingers stood when the process before this one ended."""


@runtime_checkable
class SimulatedGripper(PlacedGripper, Protocol):
    """Fingers that a simulated world without forces can be in the way of."""

    def obstruct(self, width: float) -> None:
        """Let the fingers close no further than a width [m]; 0 when nothing is between them."""


class Hardware(Protocol):
    """The joints of an arm, and its gripper where it has one."""

    gripper: Gripper | None

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Measured positions (dof,) [rad] and velocities (dof,) [rad/s].

        Raises:
            HardwareFault: with what is wrong, for the person.
        """

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Send set-points (dof,) [rad], [rad/s].

        Raises:
            HardwareFault: with what is wrong, for the person.
        """

    def close(self) -> None:
        """Let go of the device."""


@runtime_checkable
class ControlledArm(Hardware, Protocol):
    """An arm with a controller of its own, which says how it is and does things beside motion.

    Its joints are `delay` [s] behind its set-points, `ahead` [s] of it because those are sent early. The latest cycle
    of its driver so far was `late` by so much [s]. It is `stopped` from when it stops for safety until somebody has it
    recover, whoever ended the stop; who knows of one from before sets it.
    """

    ahead: float
    late: float
    stopped: bool

    @property
    def delay(self) -> float:
        """By which its joints, as they were read last, are behind its set-points [s]; more after a hold-up."""

    @property
    def state(self) -> ArmState:
        """What the arm said last, or that it says nothing."""

    def order(self, act: str, *values: float) -> int:
        """Have it do something beside motion: a number to ask about.

        `enable`, `recover`, `freedrive` (1 or 0), `payload` ([kg], and its centre of mass from the flange, x, y, z
        [m]), `output` (1 or 0, and which one).
        """

    def outcome(self, number: int) -> str | None:
        """None while it is being done; empty once it was; else why not: asked once more, nothing is known of it."""
