"""Franka Research 3 by `pylibfranka`, the maker's library (extra `franka`): see docs/robots.md before the first motion.

Joint positions at 1 kHz from a process of its own. The arm itself ends a motion whose set-points cease or jump. Joints
are unlocked, and the interface is opened, in the arm's own Desk: nothing here can do that. The hand is driven by
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
from common.errors import ConfigError
from common.hardware.driven_gripper import DrivenGripper
from common.hardware.driver import DrivenArm
from common.hardware.fingers import Fingers
from common.hardware.interface import ArmState, Gripper, Limits, Vector
from common.messages import RobotMode

Array = NDArray[np.float64]

RATE = 1000.0  # [Hz] of set-points, in the arm's time
BLEND = 0.5  # [s] in which a motion comes from where the arm is told to be to its set-points
SMOOTHED = 20  # set-points whose mean is commanded: the arm judges acceleration and jerk from one to the next
RESTS = 1e-9  # [rad] that they differ by at most, at rest
WINDOW = 100  # cycles, of which the one that came soonest tells how far the two clocks are apart
DRIFT, BEND = 0.1, 1e-3  # share by which they may run apart, and by which that changes in a cycle,
BEND_SLOW = 2e-2  # for an arm whose clock is much slower: only simulated ones are
JUDGED = 0.3  # [s] between two looks at the arm's clock,
EVEN, GRAIN = 0.98, 0.05  # which is even at so much of the host's; else steps of it by which motions are slower
LOST = 20  # cycles that the arm does without at most: then it stops by itself
WAITS = 2.0  # [s] that an act waits for the arm to rest
DOCILE = {"Idle", "Move"}
MODES: dict[str, tuple[RobotMode, str]] = {
    "Other": ("off", "is not ready: unlock the joints and activate FCI in Desk"),
    "Guiding": ("freedrive", "is moved by hand, with the buttons at its wrist"),
    "UserStopped": ("emergency_stop", "its activation device or emergency stop is pressed"),
    "AutomaticErrorRecovery": ("idle", "is recovering"),
}


class Options(Parameters):
    """Where the arm is, and how it is driven."""

    host: str = Field(description="address of the controller")
    ahead: float = Field(0.05, ge=0.01, le=0.5, description="set-points come so early [s]: shorter delays are not felt")
    realtime: bool = Field(True, description="ask the system for real-time priority; without on a host of few cores "
                                             "that simulates the arm too")
    world: Literal["real", "simulated"] = Field(
        "real", description="simulated: cameras and fingers are those of the simulated world, about a real arm or a "
                            "test host that stands for one"
    )


def simulated(options: Options) -> bool:
    """Whether the simulated world goes with the arm."""
    return options.world == "simulated"


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> DrivenArm:
    """The arm, wherever it is, and its hand where the robot has a gripper."""
    try:
        import pylibfranka  # noqa: F401
    except ImportError:
        raise ConfigError("robot.hardware.backend", "franka", "needs the extra `franka`: pip install 'zencell[franka]'"
                          ) from None
    if len(limits.names) != 7:
        raise ConfigError("robot.joints", list(limits.names), "must be the seven joints of the arm")
    gripper: Gripper | None = None
    if robot.gripper is not None:
        gripper = Fingers(robot.gripper, robot.gripper.max_width) if simulated(options) else DrivenGripper(
            "drivers.franka_hand", {"host": options.host}, robot.gripper, name=f"hand at {options.host}")
    return DrivenArm("drivers.franka", options.model_dump(), limits, gripper=gripper, ahead=options.ahead,
                     delay=options.ahead + SMOOTHED / 2 / RATE, name=f"arm at {options.host}")


def connect(options: dict[str, Any], limits: Limits) -> FrankaArm:
    """The arm, from inside the driver's process; raises what the library raises when nobody answers."""
    return FrankaArm(Options(**options))


class FrankaArm:
    """The connection to a controller, and the motion that is fed through it while there is one."""

    paces = True

    def __init__(self, options: Options) -> None:
        """Connect; nothing moves, and no motion is begun."""
        import pylibfranka

        self._library, self.hurries = pylibfranka, options.realtime
        self.rate = RATE  # in the host's time
        # The process asks for real-time priority itself, and goes on without.
        self._robot = pylibfranka.Robot(options.host, pylibfranka.RealtimeConfig.kIgnore)
        self._motion: Any = None
        self._state: Any = None
        self._speed = 1.0  # of the arm's clock
        self._judged: tuple[float, float] | None = None  # host's time and arm's when that was looked at last
        self._played = 0.0  # [s] of the arm's time, up to which it was told where to be
        self._ahead = 0.0  # [s] of the host's time before the arm's, as it is reckoned with
        self._late: list[float] = []  # [s] by which states came later than that
        self._drift = self._drifts = 0.0  # share by which the host's clock is taken to be faster: now, and soon
        self._slow = 0.0  # of that, what is known of an arm whose clock is much slower
        self._newest: deque[Vector] = deque(maxlen=SMOOTHED + 3)
        self._off = np.zeros((3, 7))  # the arm's reference less ours, and its derivatives, when the two last parted
        self._since = BLEND  # [s] ago
        self._parted = 0  # cycles that are left of it
        self._told: Vector = np.zeros(7)
        self._error = ""
        self._acts = threading.Lock()
        self._wanted = 0  # acts that wait for the arm to rest with no motion under way
        self._free = threading.Event()

    def read(self) -> ArmState:
        """The newest state; it waits for one, for a millisecond.

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
        self._judge(time.monotonic(), state.time.to_sec())
        return ArmState(list(state.q), list(state.dq), mode, message, self._speed)

    def _judge(self, now: float, arms: float) -> None:
        """Look at how fast the arm's clock runs: motions are slower for a slow one, as a simulated arm may have."""
        if self._judged is None or now - self._judged[0] > JUDGED:
            before, self._judged = self._judged, (now, arms)
            if before is not None and 0 < arms - before[1] < 2 * JUDGED:
                share = (arms - before[1]) / (now - before[0])
                self._speed = 1.0 if share > EVEN else max(math.floor(share / GRAIN - 1) * GRAIN, GRAIN)
                self._slow = 0.0 if share > EVEN else 1 / max(share, GRAIN) - 1

    def _mode(self, state: Any) -> tuple[RobotMode, str]:
        name = state.robot_mode.name
        if name == "Reflex":
            why = _named(state.current_errors) or _named(state.last_motion_errors) or self._error
            return "protective_stop", f"has stopped for a reflex ({why}): look why, then `zencell robot recover`"
        return ("running", "") if name in DOCILE else MODES[name]

    def due(self) -> list[float]:
        """One for each millisecond of the arm's own clock, told in the host's time, but as even as that."""
        now = self._state.time.to_sec()
        late = time.monotonic() - now
        if self._motion is None:
            self._ahead, self._drift, self._drifts, self._played = late, self._slow, 0.0, now
            self._late.clear()
            return [now + late]
        self._late.append(late - self._ahead)
        if len(self._late) == WINDOW:
            most = DRIFT + self._slow
            self._drifts = min(max(min(self._late) * RATE / WINDOW, -most), most)
            self._late.clear()
        cycles = round((now - self._played) * RATE)
        self._played = now
        times, bend = [], BEND_SLOW if self._slow else BEND
        for n in reversed(range(min(max(cycles, 1), LOST))):
            self._drift += min(max(self._slow + self._drifts - self._drift, -bend), bend)
            self._ahead += self._drift / RATE
            if self._slow:  # which may have changed: what is yet to come cannot be played
                self._ahead = max(min(self._ahead, late), self._ahead - self._drift / RATE)
            times.append(now - n / RATE + self._ahead)
        self.rate = RATE / (1 + max(self._drift, 0.0))
        return times

    def servo(self, points: list[Vector]) -> None:
        """Go to the last of the set-points (7,) [rad]; begins a motion where there is none.

        What the arm did without it has guessed, as if the acceleration had stayed: from there we come back to our own.
        What it takes for the velocity and acceleration then is what it judges by, in the cycle after that too.
        """
        step = 1 / RATE
        if len(points) > 1:
            self._parted = 2
        if self._wanted and (self._motion is None or self._rests):
            self._end()
            self._free.set()
            return
        if self._motion is None:
            self._motion = self._robot.start_joint_position_control(self._library.ControllerMode.JointImpedance)
            self._state, _ = self._motion.readOnce()
            self._played = self._state.time.to_sec()
            self._newest.extend([points[-1]] * (SMOOTHED + 3))
            self._parted = 1
        self._newest.extend(points)
        newest = np.array(self._newest)
        if self._parted:
            self._parted -= 1
            last, before, first = (newest[3 - n:3 - n + SMOOTHED].mean(axis=0) for n in (1, 2, 3))
            own = np.array([last, (last - before) / step, (last - 2 * before + first) / step**2])
            state = self._state
            self._off, self._since = np.array([state.q_d, state.dq_d, state.ddq_d]) - own, 0.0
            self._off[1] += self._off[2] * step / 2  # rates of the arm are differences to the cycle before
        self._since += step
        self._told = newest[3:].mean(axis=0) + _faded(self._off, self._since)
        self._motion.writeOnce(self._library.JointPositions(self._told.tolist()))

    @property
    def _rests(self) -> bool:
        return bool(np.all(np.ptp(self._newest, axis=0) <= RESTS))

    def wait(self) -> None:
        """End a motion, as nothing is followed."""
        self._end()
        if self._wanted:
            self._free.set()

    def _end(self) -> None:
        if self._motion is None:
            return
        motion, self._motion = self._motion, None
        last = self._library.JointPositions(self._told.tolist())
        last.motion_finished = True
        motion.writeOnce(last)

    def do(self, act: str, value: float = 0.0, *more: float) -> None:
        """Recovery after a reflex, and the mass of what is held."""
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
            self._free.clear()
            self._wanted += 1
            try:
                if not self._free.wait(WAITS):
                    raise ValueError("cannot be told while the arm moves")
                self._robot.set_load(value, list(more) or [0.0, 0.0, 0.0], [0.0] * 9)
            finally:
                self._wanted -= 1

    def close(self) -> None:
        """Let go of the arm, at rest."""
        self._end()


def _faded(off: Array, since: float) -> Vector:
    """What is left (7,) [rad] of an offset and its first two derivatives (3, 7) after so long [s]: 0 after `BLEND`.

    The quintic with these at its begin, and rest at 0 at its end.
    """
    u = min(since / BLEND, 1.0)
    parts = (1 - u**3 * (10 - 15 * u + 6 * u * u), u - u**3 * (6 - 8 * u + 3 * u * u),
             u * u * (1 - u * (3 - 3 * u + u * u)) / 2)
    return np.asarray(sum(part * BLEND**n * each for n, (part, each) in enumerate(zip(parts, off, strict=True))))


def _named(errors: Any) -> str:
    """What of the arm's errors is the case, in words."""
    names = (name for name in dir(errors) if not name.startswith("_") and getattr(errors, name) is True)
    return ", ".join(name.replace("_", " ") for name in names)
