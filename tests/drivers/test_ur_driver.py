"""Orders to an arm of Universal Robots, and silence of its controller, without the vendor's library."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from common.config import load_cell
from common.hardware.interface import Limits
from common.robot.model import RobotModel
from drivers.ur import LONGEST_STEP, STATE_TIMEOUT, Options, SilenceTimer, UrArm
from drivers.ur_wrench import at_flange

SIX, ROBOT = np.ones(6), RobotModel.load(load_cell("ur5").robot)
LIMITS = Limits(tuple("abcdef"), -6 * SIX, 6 * SIX, 3 * SIX, 5 * SIX, 10 * SIX, 500 * SIX)
OFF, IDLE, RUNNING, NORMAL, PROTECTIVE_STOP, EMERGENCY_STOP = 3, 5, 7, 1, 3, 7


class Controller:
    """Fake of the library's three connections; the test sets `mode`, `safety` and `program` like the pendant."""

    FLAG_UPLOAD_SCRIPT = 1

    def __init__(self) -> None:
        self.mode, self.safety, self.stamp = RUNNING, NORMAL, 0.0
        self.by_hand, self.program = False, True
        self.force = [0.0] * 6

    def getTimestamp(self) -> float:  # noqa: N802
        self.stamp += 0.002
        return self.stamp

    def teachMode(self) -> bool:  # noqa: N802
        self.by_hand = True
        return True

    def endTeachMode(self) -> bool:  # noqa: N802
        self.by_hand = False
        return True

    def disconnect(self) -> None:
        self.by_hand = False

    def powerOn(self) -> None:  # noqa: N802
        self.mode = IDLE

    def brakeRelease(self) -> None:  # noqa: N802
        self.mode = RUNNING

    def unlockProtectiveStop(self) -> None:  # noqa: N802
        self.safety = NORMAL

    def __getattr__(self, name: str) -> object:
        answers = {"getRobotMode": self.mode, "getSafetyMode": self.safety, "getRobotStatus": 1 | self.program << 1,
                   "getTargetSpeedFraction": 1.0, "getActualQ": [0.0] * 6, "getActualQd": [0.0] * 6,
                   "getActualTCPForce": self.force, "getPayloadCog": [0.0, 0.0, 0.06], "getPayload": 0.9}
        return lambda *_: answers.get(name, 0)


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> Controller:
    made = Controller()
    for module, name in (("rtde_receive", "RTDEReceiveInterface"), ("dashboard_client", "DashboardClient"),
                         ("rtde_control", "RTDEControlInterface")):
        kind = type(name, (), {"__new__": lambda cls, *_: made, "FLAG_UPLOAD_SCRIPT": 1})
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(**{name: kind}))
    return made


@pytest.fixture
def arm(controller: Controller) -> UrArm:
    arm = UrArm(Options(host="h", model="ur5e"), LIMITS)
    assert arm.read().mode == "running"
    return arm


def test_rejected_freedrive_is_not_reported_after_power_on(controller: Controller, arm: UrArm) -> None:
    controller.mode = OFF
    assert arm.read().mode == "off"
    with pytest.raises(ValueError, match="cannot freedrive: the joints are without power"):
        arm.do("freedrive", 1.0)
    controller.mode = RUNNING
    assert arm.read().mode == "running" and not controller.by_hand


def test_protective_stop_or_end_of_the_program_ends_freedrive(controller: Controller, arm: UrArm) -> None:
    arm.do("freedrive", 1.0)
    assert arm.read().mode == "freedrive" and controller.by_hand
    controller.safety = PROTECTIVE_STOP
    assert arm.read().mode == "protective_stop"
    controller.safety = NORMAL
    assert arm.read().mode == "running"
    arm.do("freedrive", 1.0)
    assert arm.read().mode == "freedrive"
    controller.program, controller.by_hand = False, False  # at the pendant
    state = arm.read()
    assert (state.mode, state.message) == ("idle", "its program has ended, and is restarted")
    controller.program = True
    assert arm.read().mode == "running"
    arm.do("freedrive", 1.0)
    assert arm.read().mode == "freedrive"
    arm.do("freedrive", 0.0)
    assert arm.read().mode == "running" and not controller.by_hand


@pytest.mark.parametrize("mode", [OFF, IDLE, RUNNING])
def test_enable_never_ends_a_stop_and_recover_never_powers(controller: Controller, arm: UrArm, mode: int) -> None:
    controller.mode, controller.safety = mode, PROTECTIVE_STOP
    with pytest.raises(ValueError, match="zencell robot recover"):
        arm.do("enable")
    assert (controller.mode, controller.safety) == (mode, PROTECTIVE_STOP)
    arm.do("recover")
    assert (controller.mode, controller.safety) == (mode, NORMAL)
    if mode != RUNNING:
        with pytest.raises(ValueError, match="zencell robot enable"):
            arm.do("recover")
        assert controller.mode == mode
    arm.do("enable")
    assert controller.mode == RUNNING


@pytest.mark.parametrize("act", ["enable", "recover"])
def test_emergency_stop_is_neither_powered_nor_released(controller: Controller, arm: UrArm, act: str) -> None:
    controller.mode, controller.safety = OFF, EMERGENCY_STOP
    with pytest.raises(ValueError, match="release it, then `zencell robot recover`"):
        arm.do(act)
    assert (controller.mode, controller.safety) == (OFF, EMERGENCY_STOP)


def test_enable_ends_with_the_reason_when_a_stop_occurs_meanwhile(controller: Controller, arm: UrArm) -> None:
    def stop() -> None:
        controller.mode, controller.safety = IDLE, PROTECTIVE_STOP

    controller.mode, controller.brakeRelease = OFF, stop  # type: ignore[method-assign]
    with pytest.raises(ValueError, match="zencell robot recover"):
        arm.do("enable")
    assert controller.safety == PROTECTIVE_STOP


@pytest.mark.parametrize("seed", range(5))
def test_wrench_of_the_base_axes_is_given_in_those_of_the_flange(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(ROBOT.lower, ROBOT.upper)
    poses = ROBOT.link_poses(q)
    in_flange = poses["base"][:3, :3].T @ poses["tool0"][:3, :3]  # link `base` has the axes of the controller's base
    force, torque = np.array([1.0, -2.0, 30.0]), np.array([0.1, 0.2, -0.3])
    found = np.array(at_flange(q.tolist(), [*force, *torque]))
    assert found[:3] == pytest.approx(in_flange.T @ force, abs=1e-4)
    assert found[3:] == pytest.approx(in_flange.T @ torque, abs=1e-4)


def test_arm_reports_force_and_payload_and_none_while_it_is_off(controller: Controller, arm: UrArm) -> None:
    controller.force = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]
    state = arm.read()
    assert np.linalg.norm(state.wrench) == pytest.approx(14 ** 0.5) and state.payload == (0.9, 0.0, 0.0, 0.06)
    controller.mode = OFF
    assert arm.read().wrench is None
    old = UrArm(Options(host="h", model="ur5"), LIMITS)
    controller.mode = RUNNING
    assert old.read().wrench is None, "a CB3 has no sensor"


def test_old_polyscope_without_the_payload_is_driven_without_force(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connect(host: str, rate: float, variables: list[str]) -> Controller:
        if "payload_cog" in variables:
            raise RuntimeError("The following variables was not found by the controller: [payload_cog],\n see ...")
        return controller

    monkeypatch.setitem(sys.modules, "rtde_receive", SimpleNamespace(RTDEReceiveInterface=connect))
    state = UrArm(Options(host="h", model="ur5e"), LIMITS).read()
    assert state.mode == "running" and state.wrench is None


def test_silence_is_the_time_of_listening_since_the_last_message() -> None:
    silence = SilenceTimer()
    assert silence.update(10.0, True) == 0.0
    lengths = [silence.update(10.0 + 0.002 * n, False) for n in range(1, 101)]
    assert lengths[-1] == pytest.approx(0.2) and lengths[70] <= STATE_TIMEOUT < lengths[80]
    assert silence.update(10.3, True) == 0.0
    assert silence.update(11.3, False) == LONGEST_STEP, "a delay of the driver itself is no silence"
    assert silence.update(11.302, False) == pytest.approx(LONGEST_STEP + 0.002)
