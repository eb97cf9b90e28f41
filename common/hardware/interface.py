"""The seam between the controller and what moves the joints, the gripper and the simulated world around them.

Times are cell time [s], passed in: a backend has no clock. `backends.py` finds and loads backends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from common.errors import ZencellError
from common.messages import (
    ConveyorSet,
    ConveyorState,
    Header,
    RobotMode,
    SceneUpdate,
    WorldEdit,
    WorldEditReply,
    WorldObjects,
)

Vector = NDArray[np.float64]
SAFETY_STOPS = ("protective_stop", "emergency_stop")  # modes of an arm that an operator has to recover


class HardwareFault(ZencellError):
    """Raised by a backend that cannot read or move. It ends the goal; new goals are rejected until the fault is over.

    The controller treats every other exception of a backend as a fault, too, and reports its type with the message.
    """


class Interrupted(HardwareFault):
    """Raised by `write` while an arm that was interrupted comes to rest by itself: the motion may continue then."""


@dataclass(frozen=True)
class Limits:
    """Limits of the joints, in the order of `names`; arrays are (dof,) in [rad], [rad/s], [rad/s^2], [rad/s^3].

    `deceleration` applies when the arm brakes for a hold or a stop. `jerk` limits what the controller adds to a
    trajectory; without it joints reach their acceleration within 10 ms.
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
        """Jerk limit (dof,) [rad/s^3]."""
        return 100.0 * self.acceleration if self.jerk is None else self.jerk

    @cached_property
    def braking(self) -> Vector:
        """Deceleration limit of a hold or a stop (dof,) [rad/s^2]."""
        return self.acceleration if self.deceleration is None else np.maximum(self.acceleration, self.deceleration)


class ArmState(NamedTuple):
    """State reported by the arm's controller: positions [rad], velocities [rad/s], mode.

    `speed` is the share set by the speed slider of its pendant; `message` says why it cannot be moved; the state is
    `age` [s] old. `wrench` and `payload` are those of `SensingArm`; None without a force sensor.
    """

    q: list[float]
    dq: list[float]
    mode: RobotMode
    message: str = ""
    speed: float = 1.0
    inputs: int = 0
    outputs: int = 0
    age: float = 0.0
    wrench: list[float] | None = None
    payload: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class GripperReading(NamedTuple):
    """State of the fingers: `width` between their inner faces [m], its rate [m/s], `effort` they press with [N].

    A cup reads `max_width` without suction, `held_width` with `holding` while it holds an object, 0 with nothing.
    `message` may say why nothing is held.
    """

    width: float
    velocity: float
    moving: bool
    holding: bool
    effort: float = 0.0
    message: str = ""


class Gripper(Protocol):
    """Two fingers that open and close, or the valve of a cup: width 0 switches suction on, `max_width` releases."""

    def command(self, width: float, now: float, effort: float) -> None:
        """Start to move the fingers to a width [m], pressing with an effort [N]; replaces a motion under way."""

    def read(self, now: float) -> GripperReading:
        """Return the state of the fingers at a time that never decreases."""


@runtime_checkable
class PlaceableGripper(Gripper, Protocol):
    """Simulated fingers."""

    def place(self, width: float) -> None:
        """Set the fingers at rest at a width [m]: where they were when the process before this one ended."""


@runtime_checkable
class SimulatedGripper(PlaceableGripper, Protocol):
    """Simulated fingers that a world without forces can block."""

    def obstruct(self, width: float) -> None:
        """Let the fingers close no further than a width [m]; 0 when nothing is between them."""


class Hardware(Protocol):
    """The joints of an arm, and its gripper where it has one."""

    gripper: Gripper | None

    def read(self, now: float) -> tuple[Vector, Vector]:
        """Return measured positions (dof,) [rad] and velocities (dof,) [rad/s].

        Raises:
            HardwareFault: with a message for the operator.
        """

    def write(self, positions: Vector, velocities: Vector, now: float) -> None:
        """Send set-points (dof,) [rad], [rad/s].

        Raises:
            HardwareFault: with a message for the operator.
        """

    def close(self) -> None:
        """Release the device."""


@runtime_checkable
class ControlledArm(Hardware, Protocol):
    """An arm with a controller of its own, which reports a state and has other functions than motion.

    The joints follow the set-points after `delay` [s], of which `ahead` [s] because set-points are sent early. `late`
    is the longest delay of a cycle of its driver so far [s]. `stopped` is True from a safety stop until an operator
    has the arm recover, even if the stop was ended at the pendant; the executor sets it after its own restart.
    """

    ahead: float
    late: float
    stopped: bool

    @property
    def delay(self) -> float:
        """Delay of the newest joint reading behind the set-points [s]; longer after the driver was held up."""

    @property
    def state(self) -> ArmState:
        """Return the newest state, or that the arm is disconnected."""

    def order(self, act: str, *values: float) -> int:
        """Start a function of the arm's controller; return a number for `outcome`.

        `enable` (power and brakes; never ends a safety stop), `recover` (ends a safety stop; never powers the arm),
        `freedrive` (1 or 0), `payload` ([kg], and its centre of mass from the flange, x, y, z
        [m]), `output` (1 or 0, and its number).
        """

    def outcome(self, number: int) -> str | None:
        """Return None while the order runs, then once "" for success or the reason of its failure."""


@runtime_checkable
class SlowedArm(ControlledArm, Protocol):
    """An arm whose own speed slider slows the set-points that it was sent.

    The executor sets `share` before each set-point: the share of the full speed at which it moves the arm, 0 to 1.
    """

    share: float


@runtime_checkable
class SensingArm(Hardware, Protocol):
    """An arm with a force sensor at its flange, or with an estimate of the force there.

    `known_payload` is what the arm's controller subtracts by itself: mass [kg] and centre of mass from the flange x, y,
    z [m]; None: nothing, the sensor also measures the weight of the gripper.
    """

    @property
    def known_payload(self) -> tuple[float, float, float, float] | None:
        """Return the payload that `wrench` does not contain."""

    def wrench(self) -> Vector | None:
        """Return force [N] and torque [N m] (6,) that act on the flange from beyond it, along the axes of the flange.

        The torque is about the origin of the flange. None: the newest reading of the arm has none.
        """


class PersistedState(NamedTuple):
    """Arm and gripper as they persist over a restart of simulated hardware.

    Joint positions `q` (dof,) [rad], `width` of the fingers [m], and the last commanded width [m] and effort [N].
    """

    q: Vector
    width: float | None = None
    commanded_width: float | None = None
    commanded_effort: float = 0.0


class WorldBackend(Protocol):
    """The simulated world around simulated hardware. A cell with real hardware has none.

    While `suspended`, another thread changes the world, which does not advance in the control cycle. `deferred` is a
    step that takes longer than a cycle: the executor runs it in a thread if it has set `defers_steps`. `restored` says
    whether the world was found as it was before a restart.
    """

    restored: bool
    suspended: bool
    defers_steps: bool
    deferred: Callable[[], None] | None

    def obstruct(self, q: Vector) -> None:
        """Block the fingers of the arm at q (dof,) [rad] at what is between them."""

    def step(self, now: float, q: Vector, gripper: GripperReading) -> None:
        """Advance to a cell time [s] with the arm at q (dof,) [rad]: objects are grasped, carried, released, fall."""

    def edit_takes_long(self, request: WorldEdit) -> bool:
        """Return whether an edit may take longer than a control cycle."""

    def edit(self, request: WorldEdit, now: float) -> WorldEditReply:
        """Change the world.

        Raises:
            Refused: with the reason; nothing has changed then.
        """

    def updates(self, header: Header) -> tuple[list[SceneUpdate], WorldObjects | None]:
        """Return the events since the last call, and all objects if it is time to publish a change."""

    def set_conveyor(self, request: ConveyorSet, header: Header) -> ConveyorState:
        """Start or stop a belt, or change its speed; return the state of all belts.

        Raises:
            Refused: no such belt, or it is not that fast.
        """

    def conveyors(self, header: Header, stopped: int) -> ConveyorState | None:
        """Return the state of all belts if it is to be published; `stopped` is the time of a STOP, or 0 [ns]."""

    def save(self, state: PersistedState) -> None:
        """Persist the world with arm and gripper, if something has changed."""

    def restore(self, stopped: bool) -> PersistedState | None:
        """Put objects and fingers where they were before a restart; return what the gripper is to continue.

        With `stopped`, fingers that press on nothing stay where they are. None when nothing was persisted.
        """

    def close(self) -> None:
        """Write what is not persisted yet."""
