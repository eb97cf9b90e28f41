"""Franka Research 3 by `pylibfranka`, the maker's library (extra `franka`): see docs/robots.md before the first motion.

Joint positions at 1 kHz from a process of its own. The arm itself ends a motion whose set-points cease or jump.
Unlocking the joints and activating the interface (FCI) is done in the arm's Desk, not here. The hand is driven by
drivers/franka_hand.py.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from common.config import Parameters, RobotConfig
from common.control.wrench import shifted
from common.errors import ConfigError
from common.hardware.driven_arm import DrivenArm
from common.hardware.interface import ArmState, Gripper, Limits, Vector
from common.hardware.mock import simulated_fingers
from common.messages import RobotMode
from common.robot.transforms import invert
from drivers import franka_hand

Array = NDArray[np.float64]

MAX_PAYLOAD = 3.0  # [kg] rated payload, from the maker's data sheet
RATE = 1000.0  # [Hz] of set-points, in the arm's time
BLEND = 0.5  # [s] in which a motion leads from the arm's own reference to the set-points
SMOOTHED = 20  # set-points whose mean is commanded: the arm checks acceleration and jerk from one to the next
AT_REST = 1e-9  # [rad] largest difference of set-points at rest
WINDOW = 100  # cycles; the earliest of them shows the offset of the two clocks
DRIFT, BEND = 0.1, 1e-3  # largest relative drift of the clocks, and its largest change in a cycle,
BEND_SLOW = 2e-2  # for an arm whose clock is much slower: only simulated ones are
CLOCK_PERIOD = 0.3  # [s] between two checks of the arm's clock,
FULL_SPEED, SPEED_STEP = 0.98, 0.05  # which counts as equal above the first; below, motions slow down in such steps
MOST_MISSED = 20  # cycles without a set-point, after which the arm stops by itself
REST_TIMEOUT = 2.0  # [s] that an act waits for the arm to be at rest
READY_MODES = {"Idle", "Move"}
MODES: dict[str, tuple[RobotMode, str]] = {
    "Other": ("off", "is not ready: unlock the joints and activate FCI in Desk"),
    "Guiding": ("freedrive", "is moved by hand, with the buttons at its wrist"),
    "UserStopped": ("emergency_stop", "its activation device or emergency stop is pressed"),
    "AutomaticErrorRecovery": ("idle", "is recovering"),
}

simulated = False  # also with a simulated world around it


class Options(Parameters):
    """Address of the arm, and how it is driven."""

    host: str = Field(description="address of the controller")
    ahead: float = Field(0.05, ge=0.01, le=0.5, description="set-points are sent so early [s]: hides shorter delays")
    realtime: bool = Field(True, description="ask the system for real-time priority; set to false on a host with few "
                                             "cores that also simulates the arm")
    world: Literal["real", "simulated"] = Field(
        "real", description="simulated: cameras and fingers are those of the simulated world, around a real arm or a "
                            "test host in its place"
    )


def has_simulated_world(options: Options) -> bool:
    """Return whether cameras, fingers and objects around the arm are simulated."""
    return options.world == "simulated"


def identity(options: Options) -> str:
    """Return the address of the arm, to which its interlocks belong."""
    return options.host


def max_payload(options: Options) -> float:
    """Return the rated payload of the arm [kg]."""
    return MAX_PAYLOAD


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> DrivenArm:
    """Create the arm at any address, and its hand if the robot has a gripper."""
    try:
        import pylibfranka  # noqa: F401
    except ImportError:
        raise ConfigError("robot.hardware.backend", "franka", "needs the extra `franka`: pip install 'zencell[franka]'"
                          ) from None
    if len(limits.names) != 7:
        raise ConfigError("robot.joints", list(limits.names), "must be the seven joints of the arm")
    gripper: Gripper | None = None
    if has_simulated_world(options):
        gripper = simulated_fingers(robot)
    elif robot.gripper is not None:
        gripper = franka_hand.create_gripper(robot.gripper, franka_hand.GripperOptions(host=options.host))
    return DrivenArm(__name__, options.model_dump(), limits, gripper=gripper, ahead=options.ahead,
                     delay=options.ahead + SMOOTHED / 2 / RATE, name=f"arm at {options.host}",
                     max_payload=max_payload(options))


def connect(options: dict[str, Any], limits: Limits) -> FrankaArm:
    """Connect to the arm, inside the driver's process; raise what the library raises when it does not answer."""
    return FrankaArm(Options(**options))


class FrankaArm:
    """The connection to a controller, and the motion in progress."""

    paced_by_arm = True

    def __init__(self, options: Options) -> None:
        """Connect; no motion starts."""
        import pylibfranka

        self._library, self.realtime = pylibfranka, options.realtime
        self.rate = RATE  # in the host's time
        # The process asks for real-time priority itself, and continues without.
        self._robot = pylibfranka.Robot(options.host, pylibfranka.RealtimeConfig.kIgnore)
        self._motion: Any = None
        self._state: Any = None
        self._speed = 1.0  # of the arm's clock, relative to the host's
        self._clock_check: tuple[float, float] | None = None  # host time and arm time of the last check [s]
        self._played = 0.0  # [s] arm time up to which set-points were sent
        self._offset = 0.0  # [s] estimated host time minus arm time
        self._lateness: list[float] = []  # [s] of states, by that estimate
        self._drift = self._target_drift = 0.0  # relative drift of the host's clock: now, and soon
        self._slow = 0.0  # known part of the drift of an arm whose clock is much slower
        self._newest: deque[Vector] = deque(maxlen=SMOOTHED + 3)
        self._deviation = np.zeros((3, 7))  # arm's reference minus ours, with two derivatives, at the last resume
        self._since_resume = BLEND  # [s]
        self._resuming = 0  # cycles left in which the deviation is measured again
        self._commanded: Vector = np.zeros(7)
        self._error = ""
        self._acts = threading.Lock()
        self._waiting_acts = 0  # acts that wait for the arm to be at rest with no motion in progress
        self._motion_ended = threading.Event()

    def read(self) -> ArmState:
        """Wait for the next state, for a millisecond, and return it.

        Raises:
            Exception: the arm does not answer.
        """
        if self._motion is None:
            state = self._robot.read_once()
        else:
            try:
                state, _ = self._motion.readOnce()
            except self._library.ControlException as error:  # the arm has ended the motion
                self._motion, self._error = None, str(error)
                state = self._robot.read_once()
        self._state = state
        mode, message = self._mode(state)
        self._check_clock(time.monotonic(), state.time.to_sec())
        return ArmState(list(state.q), list(state.dq), mode, message, self._speed, wrench=_wrench_at_flange(state),
                        payload=(state.m_load, state.F_x_Cload[0], state.F_x_Cload[1], state.F_x_Cload[2]))

    def _check_clock(self, now: float, arms: float) -> None:
        """Measure the speed of the arm's clock: a slow one, as of a simulated arm, slows motions down."""
        if self._clock_check is None or now - self._clock_check[0] > CLOCK_PERIOD:
            before, self._clock_check = self._clock_check, (now, arms)
            if before is not None and 0 < arms - before[1] < 2 * CLOCK_PERIOD:
                share = (arms - before[1]) / (now - before[0])
                if share > FULL_SPEED:
                    self._speed, self._slow = 1.0, 0.0
                else:
                    self._speed = max(math.floor(share / SPEED_STEP - 1) * SPEED_STEP, SPEED_STEP)
                    self._slow = 1 / max(share, SPEED_STEP) - 1

    def _mode(self, state: Any) -> tuple[RobotMode, str]:
        name = state.robot_mode.name
        if name == "Reflex":
            why = _active_errors(state.current_errors) or _active_errors(state.last_motion_errors) or self._error
            return "protective_stop", f"has stopped for a reflex ({why}): find the cause, then `zencell robot recover`"
        return ("running", "") if name in READY_MODES else MODES[name]

    def due(self) -> list[float]:
        """Return one time per millisecond of the arm's clock, in host time [s], as regular as the arm's clock."""
        now = self._state.time.to_sec()
        late = time.monotonic() - now
        if self._motion is None:
            self._offset, self._drift, self._target_drift, self._played = late, self._slow, 0.0, now
            self._lateness.clear()
            return [now + late]
        self._lateness.append(late - self._offset)
        if len(self._lateness) == WINDOW:
            most = DRIFT + self._slow
            self._target_drift = min(max(min(self._lateness) * RATE / WINDOW, -most), most)
            self._lateness.clear()
        cycles = round((now - self._played) * RATE)
        self._played = now
        times, bend = [], BEND_SLOW if self._slow else BEND
        for n in reversed(range(min(max(cycles, 1), MOST_MISSED))):
            self._drift += min(max(self._slow + self._target_drift - self._drift, -bend), bend)
            self._offset += self._drift / RATE
            if self._slow:  # the estimate may be wrong: set-points of the future cannot be played
                self._offset = max(min(self._offset, late), self._offset - self._drift / RATE)
            times.append(now - n / RATE + self._offset)
        self.rate = RATE / (1 + max(self._drift, 0.0))
        return times

    def servo(self, points: list[Vector]) -> None:
        """Move to the last of the set-points (7,) [rad]; start a motion if there is none.

        In cycles without a set-point the arm extrapolates with constant acceleration: a blend leads from there back to
        our curve. The arm checks limits against its extrapolated velocity and acceleration, also in the next cycle.
        """
        step = 1 / RATE
        if len(points) > 1:
            self._resuming = 2
        if self._waiting_acts and (self._motion is None or self._at_rest):
            self._end()
            self._motion_ended.set()
            return
        if self._motion is None:
            self._motion = self._robot.start_joint_position_control(self._library.ControllerMode.JointImpedance)
            self._state, _ = self._motion.readOnce()
            self._played = self._state.time.to_sec()
            self._newest.extend([points[-1]] * (SMOOTHED + 3))
            self._resuming = 1
        self._newest.extend(points)
        newest = np.array(self._newest)
        if self._resuming:
            self._resuming -= 1
            last, before, first = (newest[3 - n:3 - n + SMOOTHED].mean(axis=0) for n in (1, 2, 3))
            own = np.array([last, (last - before) / step, (last - 2 * before + first) / step**2])
            state = self._state
            self._deviation, self._since_resume = np.array([state.q_d, state.dq_d, state.ddq_d]) - own, 0.0
            self._deviation[1] += self._deviation[2] * step / 2  # the arm's rates are differences to the previous cycle
        self._since_resume += step
        self._commanded = newest[3:].mean(axis=0) + _faded(self._deviation, self._since_resume)
        self._motion.writeOnce(self._library.JointPositions(self._commanded.tolist()))

    @property
    def _at_rest(self) -> bool:
        return bool(np.all(np.ptp(self._newest, axis=0) <= AT_REST))

    def wait(self) -> None:
        """End the motion, as there are no set-points."""
        self._end()
        if self._waiting_acts:
            self._motion_ended.set()

    def _end(self) -> None:
        if self._motion is None:
            return
        motion, self._motion = self._motion, None
        last = self._library.JointPositions(self._commanded.tolist())
        last.motion_finished = True
        motion.writeOnce(last)

    def do(self, act: str, value: float = 0.0, *more: float) -> None:
        """Recover from a reflex, or set the payload."""
        with self._acts:
            if act == "recover":
                self._robot.automatic_error_recovery()
                return
            if act == "enable":
                raise ValueError("its joints are unlocked, and FCI is activated, in Desk")
            if act == "freedrive":
                raise ValueError("it is moved by hand with the buttons at its wrist")
            if act != "payload":
                raise ValueError(f"it cannot {act}: recover, payload")
            self._motion_ended.clear()
            self._waiting_acts += 1
            try:
                if not self._motion_ended.wait(REST_TIMEOUT):
                    raise ValueError("cannot be set while the arm moves")
                self._robot.set_load(value, list(more) or [0.0, 0.0, 0.0], [0.0] * 9)
            finally:
                self._waiting_acts -= 1

    def close(self) -> None:
        """Release the arm, at rest."""
        self._end()


def _faded(deviation: Array, since: float) -> Vector:
    """Return the rest (7,) [rad] of a deviation with two derivatives (3, 7) after `since` [s]: 0 after `BLEND`.

    It is the quintic that starts with these and ends at rest at 0.
    """
    u = min(since / BLEND, 1.0)
    parts = (1 - u**3 * (10 - 15 * u + 6 * u * u), u - u**3 * (6 - 8 * u + 3 * u * u),
             u * u * (1 - u * (3 - 3 * u + u * u)) / 2)
    return np.asarray(sum(part * BLEND**n * each for n, (part, each) in enumerate(zip(parts, deviation, strict=True))))


def _wrench_at_flange(state: Any) -> list[float] | None:
    """Return what acts on the flange (6,) [N], [N m], along its axes; None near a singularity, where it is unknown.

    The estimate is what the arm exerts on its surroundings, in the stiffness frame K; it is exactly 0 near a
    singularity (libfranka, RobotState). The other form of it, O_F_ext_hat_K, would need the pose of the base.
    Subtracted are the hand as configured in Desk and the load.
    """
    exerted = np.array(state.K_F_ext_hat_K)
    if not exerted.any():
        return None
    T_flange_K = _pose(state.F_T_EE) @ _pose(state.EE_T_K)
    return shifted(-exerted, invert(T_flange_K)).tolist()  # type: ignore[no-any-return]


def _pose(columns: Any) -> Array:
    """Return a pose (4, 4) from its 16 numbers, columns first."""
    return np.reshape(columns, (4, 4)).T


def _active_errors(errors: Any) -> str:
    """Return the names of the errors that are set."""
    names = (name for name in dir(errors) if not name.startswith("_") and getattr(errors, name) is True)
    return ", ".join(name.replace("_", " ") for name in names)
