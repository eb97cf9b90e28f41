"""Arms of Universal Robots, e-series and CB3, by `ur_rtde` (extra `ur`): see docs/robots.md before the first motion.

`servoJ` at the controller's rate from a process of its own; a watchdog in the arm's own program ends the motion when
that process or the network dies. Nothing is powered, released or recovered unless somebody asks for it.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections import deque
from typing import Any, Literal

import numpy as np
from pydantic import Field

from common.config import Parameters, RobotConfig
from common.errors import ConfigError
from common.hardware.driven_gripper import DrivenGripper
from common.hardware.driver import DrivenArm
from common.hardware.fingers import Fingers
from common.hardware.interface import ArmState, Gripper, Limits, Vector
from common.messages import RobotMode

MODELS = r"^ur((3|5|10)e?|16e|15|20|30)$"
CB3 = re.compile(r"^ur(3|5|10)$")
LATEST = 0.15  # [s] without a new state of the arm, after which it counts as gone
LOOK = 0.02  # [s] of them that count at most from one look to the next: who was held up has not listened
WATCHDOG = 10.0  # [Hz] less often, the arm's program ends by itself
SMOOTHED = 0.02  # [s] whose mean is commanded: between the cycles of who sends them the jerk is up to 5 times as much
MOVES = 0.02  # [rad/s] faster than this, a joint does not rest
SETTLES = 0.5  # [s] in which the arm rests once its set-points do
PROGRAM_RUNS = 2  # of the robot's status bits
POWER = 30.0  # [s] in which joints are powered, and brakes released
VARIABLES = ["timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "safety_status_bits", "runtime_state",
             "target_speed_fraction", "speed_scaling", "robot_status_bits", "actual_digital_input_bits",
             "actual_digital_output_bits"]
SAFETY: dict[int, tuple[RobotMode, str]] = {
    3: ("protective_stop", "protective stop: look why, then `zencell robot recover`"),
    4: ("protective_stop", "in recovery mode: move the joints back within their limits at the pendant"),
    5: ("protective_stop", "safeguard stop: the safeguard input is open"),
    6: ("emergency_stop", "the system's emergency stop is pressed"),
    7: ("emergency_stop", "the emergency stop is pressed"),
    8: ("fault", "safety violation: restart safety at the pendant"),
    9: ("fault", "fault of the safety system: restart the controller"),
}
MODES: dict[int, tuple[RobotMode, str]] = {
    3: ("off", "the joints are without power: `zencell robot enable`"),
    4: ("idle", "is being powered"),
    5: ("idle", "the brakes are on: `zencell robot enable`"),
}


class Options(Parameters):
    """Where the arm is, and what it is."""

    host: str = Field(description="address of the controller")
    model: str = Field(pattern=MODELS, description="what it is, as its plate says in small letters")
    ahead: float = Field(0.05, ge=0.01, le=0.5, description="set-points come so early [s]: shorter delays are not felt")
    lookahead: float = Field(0.03, ge=0.03, le=0.2, description="servoJ smooths over this [s]")
    gain: float = Field(300.0, ge=100, le=2000, description="servoJ follows with this gain")
    world: Literal["real", "simulated"] = Field(
        "real", description="simulated: cameras and fingers are those of the simulated world, about a real arm or a "
                            "test host that stands for one"
    )
    gripper: Literal["", "2f85", "2f140"] = Field(
        "", description="Robotiq's gripper at the arm, where the robot file has a gripper section"
    )


def simulated(options: Options) -> bool:
    """Whether the simulated world goes with the arm."""
    return options.world == "simulated"


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> DrivenArm:
    """The arm, wherever it is."""
    try:
        import rtde_control  # noqa: F401
    except ImportError:
        raise ConfigError("robot.hardware.backend", "ur", "needs the extra `ur`: pip install 'zencell[ur]'") from None
    gripper: Gripper | None = None
    if robot.gripper is not None and simulated(options):
        gripper = Fingers(robot.gripper, robot.gripper.max_width)
    elif robot.gripper is not None and options.gripper:
        gripper = DrivenGripper(
            "drivers.robotiq", {"host": options.host, "model": options.gripper}, robot.gripper,
            name=f"{options.gripper} at {options.host}")
    delay = options.ahead + options.lookahead + Smoothing(rate_of(options.model)).delay
    return DrivenArm("drivers.ur", options.model_dump(), limits, gripper=gripper, name=f"{options.model} at "
                     f"{options.host}", ahead=options.ahead, delay=delay)


def connect(options: dict[str, Any], limits: Limits) -> UrArm:
    """The arm, from inside the driver's process; raises what the library raises when nobody answers."""
    return UrArm(Options(**options), limits)


def rate_of(model: str) -> float:
    """How often its controller wants a set-point [Hz]."""
    return 125.0 if CB3.match(model) else 500.0


class Smoothing:
    """The mean of the newest set-points, which the arm is `delay` [s] behind for that."""

    def __init__(self, rate: float) -> None:
        """Take set-points that come at a rate [Hz]."""
        self._newest: deque[Vector] = deque(maxlen=max(1, round(SMOOTHED * rate)))
        self.delay = (max(1, round(SMOOTHED * rate)) - 1) / (2 * rate)

    def begin(self) -> None:
        """The arm rests where the next set-point is."""
        self._newest.clear()

    def after(self, q: Vector) -> Vector:
        """Where to be (dof,) [rad] now that a set-point has come."""
        self._newest.append(q)
        return np.asarray(np.mean(self._newest, axis=0))


class Silence:
    """How long [s] nothing was heard by somebody who listened."""

    def __init__(self) -> None:
        """Nothing was heard yet."""
        self._looked, self._silent = -math.inf, 0.0

    def lasts(self, now: float, heard: bool) -> float:
        """Its length at a look at some time [s]; of the time since the look before no more than LOOK counts."""
        self._silent = 0.0 if heard else self._silent + min(now - self._looked, LOOK)
        self._looked = now
        return self._silent


class UrArm:
    """The three connections to a controller: what it says, the program that moves it, and its dashboard."""

    paces, hurries = False, True

    def __init__(self, options: Options, limits: Limits) -> None:
        """Connect; an arm that is ready gets its program, and rests."""
        import rtde_receive
        from dashboard_client import DashboardClient

        self._options = options
        self._deceleration = float(limits.braking.min())
        self.rate = rate_of(options.model)
        self._smoothing = Smoothing(self.rate)
        self._dashboard = DashboardClient(options.host)
        self._dashboard.connect()
        self._receive = rtde_receive.RTDEReceiveInterface(options.host, self.rate, VARIABLES)
        self._control: Any = None
        self._using = threading.Lock()  # the control interface, which is not made for two
        self._stamp, self._since = -1.0, time.monotonic()
        self._states, self._taking = Silence(), Silence()
        self._freedrive = self._servoing = False
        self._began = False  # whether the program that was uploaded was seen to run
        self._ending: threading.Thread | None = None

    def read(self) -> ArmState:
        """The newest state; the program is uploaded where the arm is ready and has none.

        Raises:
            ConnectionError: nothing new came for a while.
        """
        stamp, now = self._receive.getTimestamp(), time.monotonic()
        silent = self._states.lasts(now, stamp != self._stamp)
        if silent == 0.0:
            self._stamp, self._since = stamp, now
        elif silent > LATEST:
            raise ConnectionError(f"no word from the controller for {now - self._since:.2f} s")
        mode, message = self._mode()
        if self._control is not None:
            runs = bool(self._receive.getRobotStatus() & PROGRAM_RUNS)
            if self._began and not runs and mode in ("running", "freedrive"):
                mode, message = "idle", "its program has ended, and is begun again"
            self._began = self._began or runs
        with self._using:
            if mode == "running" and self._control is None:
                self._upload()
            elif mode not in ("running", "freedrive") and self._control is not None:
                self._drop()
        speed = self._receive.getTargetSpeedFraction()
        return ArmState(
            self._receive.getActualQ(), self._receive.getActualQd(), mode, message, min(max(speed, 0.0), 1.0),
            self._receive.getActualDigitalInputBits(), self._receive.getActualDigitalOutputBits(), now - self._since,
        )

    def _mode(self) -> tuple[RobotMode, str]:
        safety, robot = self._receive.getSafetyMode(), self._receive.getRobotMode()
        if safety in SAFETY:
            return SAFETY[safety]
        if robot != 7:
            return MODES.get(robot, ("fault", f"robot mode {robot}"))
        if self._freedrive:
            return "freedrive", "is moved by hand: `zencell robot freedrive off`"
        return "running", ""

    def _upload(self) -> None:
        import rtde_control

        if self._ending is not None:
            self._ending.join()  # the registers are for one at a time
        self._began = False
        flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        self._control = rtde_control.RTDEControlInterface(self._options.host, self.rate, flags)
        self._control.setWatchdog(WATCHDOG)

    def _drop(self) -> None:
        control, self._control, self._servoing = self._control, None, False
        self._freedrive = False  # it was the program that let go of the joints
        self._ending = threading.Thread(target=control.disconnect, daemon=True)  # it waits for threads of its own
        self._ending.start()

    def due(self) -> list[float]:
        """One, now: who is late slows down."""
        return [time.monotonic()]

    def servo(self, points: list[Vector]) -> None:
        """Go to the last of the set-points (6,) [rad], as it is smoothed, within one period.

        Raises:
            ConnectionError: the program in the arm does not run any more.
        """
        with self._using:
            if not self._servoing:
                self._smoothing.begin()
            q = self._smoothing.after(points[-1]).tolist()
            taken = self._control is not None and self._control.servoJ(
                q, 0.0, 0.0, 1 / self.rate, self._options.lookahead, self._options.gain)
            begun, self._servoing = not self._servoing, True
        if self._taking.lasts(time.monotonic(), taken or begun) > LATEST:  # else it may be about to say why
            raise ConnectionError("the arm's program does not take set-points")

    def wait(self) -> None:
        """Tell the arm's program that we are there."""
        with self._using:
            if self._control is not None:
                self._control.kickWatchdog()

    def _rest(self) -> None:
        if self._control is not None and self._servoing:
            self._control.servoStop(self._deceleration)
            self._servoing = False

    def do(self, act: str, value: float = 0.0, *more: float) -> None:
        """Power and brakes, recovery, freedrive, payload."""
        if act in ("enable", "recover"):
            self._enable()
            return
        if act == "freedrive" and value:
            self._freedrive = True  # from now on nothing is servoed
        elif act == "payload":
            end = time.monotonic() + SETTLES
            while max(map(abs, self._receive.getActualQd())) > MOVES:
                if time.monotonic() > end:
                    raise ValueError("cannot be told while the arm moves")
                time.sleep(1 / self.rate)
        with self._using:
            if self._control is None:
                self._freedrive = False
                raise ValueError(f"cannot {act}: {self._mode()[1] or 'the arm is not ready'}")
            if act == "freedrive":
                self._rest()
                done = self._control.teachMode() if value else self._control.endTeachMode()
                self._freedrive = bool(value) and done
            elif act == "payload":
                self._rest()  # its program takes no other order while it servoes
                done = self._control.setPayload(value, list(more) or [0.0, 0.0, 0.0])
            else:
                raise ValueError(f"it cannot {act}: enable, recover, freedrive, payload")
        if not done:
            raise ValueError("the arm refused it")

    def _enable(self) -> None:
        safety = self._receive.getSafetyMode()
        if safety == 3:
            self._dashboard.closeSafetyPopup()
            self._dashboard.unlockProtectiveStop()
        elif safety in SAFETY:
            raise ValueError(SAFETY[safety][1])
        end = time.monotonic() + POWER
        robot = self._receive.getRobotMode()
        if robot != 7:
            self._dashboard.powerOn()
            self._dashboard.brakeRelease()
        while (robot := self._receive.getRobotMode()) != 7 or self._receive.getSafetyMode() in SAFETY:
            if time.monotonic() > end:
                raise ValueError(f"the arm is in mode {robot}, safety mode {self._receive.getSafetyMode()}")
            time.sleep(0.02)
        self._freedrive = False

    def close(self) -> None:
        """Let go of the arm, at rest."""
        self._rest()
        if self._control is not None:
            self._control.stopScript()
