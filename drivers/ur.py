"""Arms of Universal Robots, e-series and CB3, by `ur_rtde` (extra `ur`): see docs/robots.md before the first motion.

`servoJ` at the controller's rate from a process of its own; a watchdog in the arm's own program ends the motion when
that process or the network dies. The driver powers, releases and recovers the arm only on request of an operator.
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
from common.hardware.driven_arm import DrivenArm
from common.hardware.interface import ArmState, Gripper, Limits, Vector
from common.hardware.mock import simulated_fingers
from common.messages import RobotMode
from drivers import robotiq
from drivers.ur_wrench import at_flange

# Rated payload [kg] by model, from the maker's data sheets; the UR30 carries its 35 kg with the tool pointing down.
PAYLOADS = {"3": 3.0, "5": 5.0, "10": 10.0, "3e": 3.0, "5e": 5.0, "7e": 7.5, "10e": 12.5, "12e": 12.5, "16e": 16.0,
            "15": 15.0, "20": 20.0, "30": 35.0}
MODELS = rf"^ur({'|'.join(PAYLOADS)})$"
CB3 = re.compile(r"^ur(3|5|10)$")
STATE_TIMEOUT = 0.15  # [s] without a new state of the arm, after which it counts as disconnected
LONGEST_STEP = 0.02  # [s] that count of the time between two checks: a driver that was held up has not listened
POLL = 3e-4  # [s] between two looks for a new state
EARLY = 0.2  # share of a cycle of the controller at which set-points are sent: this process may be late, but not early
CLOCK_DRIFT, CLOCK_BEND = 1e-4, 1e-3  # relative drift of the controller's clock, and of its estimate at most
WATCHDOG = 10.0  # [Hz] below this rate the arm's program ends by itself
SMOOTHED = 0.02  # [s] whose mean is commanded: between the sender's cycles the jerk is up to 5 times as large
STANDSTILL = 0.02  # [rad/s] a faster joint is not at rest
SETTLE_TIMEOUT = 0.5  # [s] for the arm to come to rest once its set-points are at rest
PROGRAM_RUNS = 2  # of the robot's status bits
POWER_TIMEOUT = 30.0  # [s] for powering the joints and releasing the brakes
RELEASE_TIMEOUT = 10.0  # [s] for the end of a protective stop
RUNNING, PROTECTIVE_STOP = 7, 3  # robot mode, safety mode
VARIABLES = ["timestamp", "actual_q", "actual_qd", "robot_mode", "safety_mode", "safety_status_bits", "runtime_state",
             "target_speed_fraction", "speed_scaling", "robot_status_bits", "actual_digital_input_bits",
             "actual_digital_output_bits"]
SENSOR = ["actual_TCP_force", "payload", "payload_cog"]  # of arms with a force sensor
NOT_FOUND = "not found by the controller"  # in the library's message about an unknown variable
SAFETY: dict[int, tuple[RobotMode, str]] = {
    3: ("protective_stop", "protective stop: find the cause, then `zencell robot recover`"),
    4: ("protective_stop", "in recovery mode: move the joints back within their limits at the pendant"),
    5: ("protective_stop", "safeguard stop: the safeguard input is open"),
    6: ("emergency_stop", "the system's emergency stop is pressed: release it, then `zencell robot recover`"),
    7: ("emergency_stop", "the emergency stop is pressed: release it, then `zencell robot recover`"),
    8: ("fault", "safety violation: restart safety at the pendant"),
    9: ("fault", "fault of the safety system: restart the controller"),
}
MODES: dict[int, tuple[RobotMode, str]] = {
    3: ("off", "the joints are without power: `zencell robot enable`"),
    4: ("idle", "is being powered"),
    5: ("idle", "the brakes are on: `zencell robot enable`"),
}

simulated = False  # also with a simulated world around it


class Options(Parameters):
    """Address and model of the arm, and how it is servoed."""

    host: str = Field(description="address of the controller")
    model: str = Field(pattern=MODELS, description="as on its type plate, in small letters")
    ahead: float = Field(0.05, ge=0.01, le=0.5, description="set-points are sent so early [s]: hides shorter delays")
    lookahead: float = Field(0.03, ge=0.03, le=0.2, description="servoJ smooths over this [s]")
    gain: float = Field(300.0, ge=100, le=2000, description="servoJ follows with this gain")
    world: Literal["real", "simulated"] = Field(
        "real", description="simulated: cameras and fingers are those of the simulated world, around a real arm or a "
                            "test host in its place"
    )
    gripper: Literal["", "2f85", "2f140"] = Field(
        "", description="Robotiq gripper at the arm, where the robot file has a gripper section without hardware"
    )


def has_simulated_world(options: Options) -> bool:
    """Return whether cameras, fingers and objects around the arm are simulated."""
    return options.world == "simulated"


def identity(options: Options) -> str:
    """Return the address of the arm, to which its interlocks belong."""
    return options.host


def max_payload(options: Options) -> float:
    """Return the rated payload of the arm [kg]."""
    return PAYLOADS[options.model.removeprefix("ur")]


def create(robot: RobotConfig, limits: Limits, start: Vector, options: Options) -> DrivenArm:
    """Create the arm at any address."""
    try:
        import rtde_control  # noqa: F401
    except ImportError:
        raise ConfigError("robot.hardware.backend", "ur", "needs the extra `ur`: pip install 'zencell[ur]'") from None
    gripper: Gripper | None = None
    if has_simulated_world(options):
        gripper = simulated_fingers(robot)
    elif robot.gripper is not None and options.gripper:
        gripper = robotiq.create_gripper(
            robot.gripper, robotiq.GripperOptions(host=options.host, model=options.gripper))
    delay = options.ahead + options.lookahead + Smoothing(rate_of(options.model)).delay
    return DrivenArm(__name__, options.model_dump(), limits, gripper=gripper, name=f"{options.model} at "
                     f"{options.host}", ahead=options.ahead, delay=delay, max_payload=max_payload(options))


def connect(options: dict[str, Any], limits: Limits) -> UrArm:
    """Connect to the arm, inside the driver's process; raise what the library raises when it does not answer."""
    return UrArm(Options(**options), limits)


def rate_of(model: str) -> float:
    """Return the rate at which the controller of a model takes set-points [Hz]."""
    return 125.0 if CB3.match(model) else 500.0


class Smoothing:
    """The mean of the newest set-points, which delays them by `delay` [s]."""

    def __init__(self, rate: float) -> None:
        """Smooth set-points that arrive at a rate [Hz]."""
        self._newest: deque[Vector] = deque(maxlen=max(1, round(SMOOTHED * rate)))
        self.delay = (max(1, round(SMOOTHED * rate)) - 1) / (2 * rate)

    def reset(self) -> None:
        """Start at the next set-point, at rest."""
        self._newest.clear()

    def add(self, q: Vector) -> Vector:
        """Return the smoothed position (dof,) [rad] after a new set-point."""
        self._newest.append(q)
        return np.asarray(np.mean(self._newest, axis=0))


class SilenceTimer:
    """Measures for how long [s] nothing new was received while the driver listened."""

    def __init__(self) -> None:
        """Start without a message."""
        self._checked, self._silent = -math.inf, 0.0

    def update(self, now: float, received: bool) -> float:
        """Return the silence [s] at a time [s]; at most LONGEST_STEP counts of the time since the last call."""
        self._silent = 0.0 if received else self._silent + min(now - self._checked, LONGEST_STEP)
        self._checked = now
        return self._silent


class UrArm:
    """The three connections to a controller: its state, the program that moves the arm, and its dashboard."""

    paced_by_arm, realtime, slowed = True, True, True

    def __init__(self, options: Options, limits: Limits) -> None:
        """Connect; an arm that is ready gets its program and stays at rest."""
        import rtde_receive
        from dashboard_client import DashboardClient

        self._options = options
        self._deceleration = float(limits.braking.min())
        self.rate = rate_of(options.model)
        self._smoothing = Smoothing(self.rate)
        self._dashboard = DashboardClient(options.host)
        self._dashboard.connect()
        self._senses = CB3.match(options.model) is None
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(
                options.host, self.rate, VARIABLES + SENSOR if self._senses else VARIABLES)
        except RuntimeError as error:
            if NOT_FOUND not in str(error) or not self._senses:
                raise
            self._senses = False  # an old PolyScope, which does not report the payload
            self._receive = rtde_receive.RTDEReceiveInterface(options.host, self.rate, VARIABLES)
        self._control: Any = None
        self._control_lock = threading.Lock()  # the control interface is not thread-safe
        self._stamp, self._since = -1.0, time.monotonic()
        self._cycle = 0  # of the controller, in which the newest set-point was sent
        self._offset = 0.0  # estimated host time minus the controller's time [s], when its state arrives at once
        self._no_state, self._not_accepted = SilenceTimer(), SilenceTimer()
        self._freedrive = self._servoing = False
        self._program_seen = False  # whether the uploaded program was seen running
        self._ending: threading.Thread | None = None

    def read(self) -> ArmState:
        """Return the newest state early in the controller's next cycle; upload the program to a ready arm.

        Raises:
            ConnectionError: no new state for STATE_TIMEOUT.
        """
        end = (min(self._cycle, self._cycle_now()) + 1 + EARLY) / self.rate + self._offset
        received = False
        while True:
            stamp, now = self._receive.getTimestamp(), time.monotonic()
            if stamp != self._stamp:
                self._follow_clock(stamp, now)
                self._stamp, self._since, received = stamp, now, True
            if now >= end:
                break
            time.sleep(min(end - now, POLL))
        silent = self._no_state.update(now, received)
        if silent > STATE_TIMEOUT:
            raise ConnectionError(f"no message from the controller for {now - self._since:.2f} s")
        mode, message = self._mode()
        if self._control is not None:
            runs = bool(self._receive.getRobotStatus() & PROGRAM_RUNS)
            if self._program_seen and not runs and mode in ("running", "freedrive"):
                mode, message = "idle", "its program has ended, and is restarted"
            self._program_seen = self._program_seen or runs
        with self._control_lock:
            if mode == "running" and self._control is None:
                self._upload()
            elif mode not in ("running", "freedrive") and self._control is not None:
                self._drop()
        speed, q = self._receive.getTargetSpeedFraction(), self._receive.getActualQ()
        state = ArmState(
            q, self._receive.getActualQd(), mode, message, min(max(speed, 0.0), 1.0),
            self._receive.getActualDigitalInputBits(), self._receive.getActualDigitalOutputBits(), now - self._since,
        )
        if self._senses and mode == "running":
            x, y, z = self._receive.getPayloadCog()
            state = state._replace(wrench=at_flange(q, self._receive.getActualTCPForce()),
                                   payload=(self._receive.getPayload(), x, y, z))
        return state

    def _mode(self) -> tuple[RobotMode, str]:
        safety, robot = self._receive.getSafetyMode(), self._receive.getRobotMode()
        if safety in SAFETY:
            return SAFETY[safety]
        if robot != RUNNING:
            return MODES.get(robot, ("fault", f"robot mode {robot}"))
        if self._freedrive:
            return "freedrive", "is moved by hand: `zencell robot freedrive off`"
        return "running", ""

    def _upload(self) -> None:
        import rtde_control

        if self._ending is not None:
            self._ending.join()  # only one program may use the registers
        self._program_seen = False
        flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        self._control = rtde_control.RTDEControlInterface(self._options.host, self.rate, flags)
        self._control.setWatchdog(WATCHDOG)

    def _drop(self) -> None:
        control, self._control, self._servoing = self._control, None, False
        self._freedrive = False  # the program had released the joints
        self._ending = threading.Thread(target=control.disconnect, daemon=True)  # it waits for its own threads
        self._ending.start()

    def _follow_clock(self, stamp: float, now: float) -> None:
        """Estimate the offset of the controller's clock by the states that arrived earliest, without a jump."""
        late, passed = now - stamp - self._offset, stamp - self._stamp
        if passed > 0 and abs(late) < STATE_TIMEOUT:
            self._offset += max(min(late, CLOCK_DRIFT * passed), -CLOCK_BEND * passed)
        else:  # it was restarted, or held up
            self._offset = now - stamp

    def due(self) -> list[float]:
        """Return one time, at which the controller starts its next cycle: a late driver slows the motion down."""
        self._cycle = self._cycle_now()
        return [(self._cycle + 1) / self.rate + self._offset]

    def _cycle_now(self) -> int:
        """Return the number of the controller's present cycle, by its clock."""
        return math.floor((time.monotonic() - self._offset) * self.rate)

    def servo(self, points: list[Vector]) -> None:
        """Move to the last of the set-points (6,) [rad], smoothed, within one period.

        Raises:
            ConnectionError: the arm's program does not run any more.
        """
        with self._control_lock:
            if not self._servoing:
                self._smoothing.reset()
            q = self._smoothing.add(points[-1]).tolist()
            accepted = self._control is not None and self._control.servoJ(
                q, 0.0, 0.0, 1 / self.rate, self._options.lookahead, self._options.gain)
            first, self._servoing = not self._servoing, True
        # For a moment the arm may be about to report why it does not accept them.
        if self._not_accepted.update(time.monotonic(), accepted or first) > STATE_TIMEOUT:
            raise ConnectionError("the arm's program does not accept set-points")

    def wait(self) -> None:
        """Keep the watchdog of the arm's program from ending it."""
        with self._control_lock:
            if self._control is not None:
                self._control.kickWatchdog()

    def _stop_servo(self) -> None:
        if self._control is not None and self._servoing:
            self._control.servoStop(self._deceleration)
            self._servoing = False

    def do(self, act: str, value: float = 0.0, *more: float) -> None:
        """Enable, recover, free-drive, or set the payload."""
        if act == "enable":
            self._enable()
            return
        if act == "recover":
            self._recover()
            return
        if act == "freedrive" and value:
            self._freedrive = True  # no set-points from now on
        elif act == "payload":
            end = time.monotonic() + SETTLE_TIMEOUT
            while max(map(abs, self._receive.getActualQd())) > STANDSTILL:
                if time.monotonic() > end:
                    raise ValueError("cannot be set while the arm moves")
                time.sleep(1 / self.rate)
        with self._control_lock:
            if self._control is None:
                self._freedrive = False
                raise ValueError(f"cannot {act}: {self._mode()[1] or 'the arm is not ready'}")
            if act == "freedrive":
                self._stop_servo()
                done = self._control.teachMode() if value else self._control.endTeachMode()
                self._freedrive = bool(value) and done
            elif act == "payload":
                self._stop_servo()  # while it servoes, its program accepts nothing else
                done = self._control.setPayload(value, list(more) or [0.0, 0.0, 0.0])
            else:
                raise ValueError(f"it cannot {act}: enable, recover, freedrive, payload")
        if not done:
            raise ValueError("the arm refused it")

    def _enable(self) -> None:
        """Power the joints and release the brakes; never end a safety stop."""
        end, commanded = time.monotonic() + POWER_TIMEOUT, False
        while True:
            safety, robot = self._receive.getSafetyMode(), self._receive.getRobotMode()
            if safety in SAFETY:
                raise ValueError(SAFETY[safety][1])
            if robot == RUNNING:
                return
            if not commanded:
                self._dashboard.powerOn()
                self._dashboard.brakeRelease()
                commanded = True
            if time.monotonic() > end:
                raise ValueError(f"the arm is in mode {robot}, safety mode {safety}")
            time.sleep(0.02)

    def _recover(self) -> None:
        """End a protective stop; never power the joints."""
        safety, robot = self._receive.getSafetyMode(), self._receive.getRobotMode()
        if safety == PROTECTIVE_STOP:
            self._dashboard.closeSafetyPopup()
            self._dashboard.unlockProtectiveStop()
            end = time.monotonic() + RELEASE_TIMEOUT
            while (safety := self._receive.getSafetyMode()) == PROTECTIVE_STOP:
                if time.monotonic() > end:
                    raise ValueError(f"the protective stop was not released within {RELEASE_TIMEOUT:g} s")
                time.sleep(0.02)
        elif safety not in SAFETY and robot != RUNNING:
            raise ValueError(MODES.get(robot, ("fault", f"robot mode {robot}"))[1])
        if safety in SAFETY:
            raise ValueError(SAFETY[safety][1])

    def close(self) -> None:
        """Release the arm, at rest."""
        self._stop_servo()
        if self._control is not None:
            self._control.stopScript()
