"""Grippers behind a driver process: the protocol of Robotiq, and failures of any driver."""

import time
from collections.abc import Iterator

import numpy as np
import pytest

from common.config import GripperConfig, load_cell
from common.control.gripper_controller import GripperController
from common.errors import ConfigError
from common.hardware.driven_gripper import DrivenGripper
from common.hardware.interface import HardwareFault, Limits
from common.hardware.loading import load_hardware
from common.messages import GripperCommand, GripperState
from drivers.robotiq import MODELS, Robotiq
from tests.doubles.robotiq import RobotiqHost

TIMEOUT = 20.0
SIX = np.ones(6)
LIMITS = Limits(tuple("abcdef"), -6 * SIX, 6 * SIX, 3 * SIX, 5 * SIX, 10 * SIX, 500 * SIX)
CONFIG: GripperConfig = load_cell("ur5", ["robot.gripper.speed=0.15"]).robot.gripper  # a 2F-85
TOUCH = 110  # [counts] at which the fingers meet the object,
WIDE = 0.085 * (228 - TOUCH) / 225  # [m] apart then


@pytest.fixture
def host() -> Iterator[RobotiqHost]:
    with RobotiqHost() as host:
        yield host


def options(host: RobotiqHost) -> dict:
    return {"host": "127.0.0.1", "port": host.port, "model": "2f85"}


class Driven:
    """The gripper behind its controller, cycle by cycle."""

    def __init__(self, gripper: DrivenGripper) -> None:
        self.gripper, self.controller = gripper, GripperController(gripper, CONFIG)
        self.problem = ""

    def cycle(self) -> GripperState:
        now = time.monotonic()
        try:
            self.controller.update(self.gripper.read(now), now)
            self.problem = ""
        except HardwareFault as fault:
            self.problem = str(fault)
            self.controller.fault(self.problem)
        time.sleep(0.01)
        return self.controller.state

    def until(self, condition) -> GripperState:
        end = time.monotonic() + TIMEOUT
        while not condition(state := self.cycle()):
            assert time.monotonic() < end, (state, self.problem)
        return state

    def grip(self, name: str, width: float, **more: object) -> GripperState:
        """Return the final state of a command."""
        self.until(lambda _: not self.problem)
        self.controller.command(GripperCommand(id=name, width=width, **more), time.monotonic())
        return self.until(lambda state: state.state != "active")


@pytest.fixture
def driven(host: RobotiqHost) -> Iterator[Driven]:
    gripper = DrivenGripper("drivers.robotiq", options(host), CONFIG, name="a 2f85")
    yield Driven(gripper)
    gripper.close()


@pytest.mark.parametrize("answers", [b"ack", b"ack\n"])
def test_fingers_open_and_close_to_a_width(host: RobotiqHost, driven: Driven, answers: bytes) -> None:
    host.gripper.answers = answers
    for n, width in enumerate((0.03, 0.085, 0.0)):
        state = driven.grip(f"g{n}", width)
        assert (state.state, state.holding) == ("succeeded", False)
        assert state.width == pytest.approx(width, abs=3e-4)  # a count


def test_object_is_held_with_the_commanded_effort_and_released(
    host: RobotiqHost, driven: Driven,
) -> None:
    host.gripper.thing = TOUCH
    state = driven.grip("close", 0.0, effort=100.0, expected_width=WIDE)
    assert (state.state, state.outcome, state.holding) == ("succeeded", "grasped", True)
    assert state.width == pytest.approx(WIDE, abs=3e-4) and state.effort == pytest.approx(100.0, abs=1.0)
    assert driven.grip("again", 0.0, expected_width=0.02).outcome == "too_wide"
    host.gripper.thing = None
    state = driven.grip("open", 0.08)
    assert (state.state, state.holding) == ("succeeded", False)


def test_gripper_that_is_not_activated_or_has_a_fault_reports_it_and_never_moves(host: RobotiqHost) -> None:
    host.gripper.registers["STA"] = 0
    driven = Driven(DrivenGripper("drivers.robotiq", options(host), CONFIG, name="a 2f85"))
    driven.until(lambda _: "a 2f85: the gripper is not activated (state 0)" in driven.problem)
    with pytest.raises(HardwareFault, match="not activated"):
        driven.gripper.command(0.0, time.monotonic(), 20.0)
    host.gripper.registers["STA"] = 3
    driven.until(lambda _: not driven.problem)
    host.gripper.registers["FLT"] = 14
    driven.until(lambda _: "has fault 14" in driven.problem)
    driven.gripper.close()
    assert host.gripper.registers["GTO"] == 0


@pytest.mark.slow
def test_lost_gripper_is_a_fault_and_is_connected_again() -> None:
    with RobotiqHost() as host:
        driven = Driven(DrivenGripper("drivers.robotiq", options(host), CONFIG, name="a 2f85"))
        assert driven.grip("first", 0.02).state == "succeeded"
    driven.until(lambda _: "the gripper's program has closed the connection" in driven.problem)
    driven.until(lambda _: "refused" in driven.problem)
    with RobotiqHost(host.port) as again:
        driven.until(lambda _: not driven.problem)
        assert again.gripper.registers["GTO"] == 0  # without a command
        driven.gripper.close()


@pytest.mark.parametrize("answer", [b"POS\n", b"POS x\n", b"?\n", b"y" * 300])
def test_invalid_answer_ends_the_driver_with_one_line(
    host: RobotiqHost, answer: bytes, monkeypatch: pytest.MonkeyPatch,
) -> None:
    gripper = Robotiq("127.0.0.1", MODELS["2f85"], 0.1, host.port)
    monkeypatch.setattr(host.gripper, "answer", lambda line: answer)
    try:
        with pytest.raises((RuntimeError, ConnectionError), match="the gripper"):
            gripper.read()
    finally:
        gripper.close()


def test_ur_arm_brings_the_gripper_of_its_option() -> None:
    pytest.importorskip("rtde_control", reason="make setup EXTRAS=ur")
    robot = load_cell("ur5", ["robot.hardware.backend=ur", "robot.hardware.options.host=127.0.0.9",
                              "robot.hardware.options.model=ur5e", "robot.hardware.options.gripper=2f85"]).robot
    arm = load_hardware(robot, LIMITS, LIMITS.lower)
    assert isinstance(arm.gripper, DrivenGripper)
    arm.gripper.close()
    arm.close()
    with pytest.raises(ConfigError, match=r"robot\.hardware\.options\.gripper: '3f'"):
        load_hardware(robot.model_copy(update={"hardware": robot.hardware.model_copy(
            update={"options": {**robot.hardware.options, "gripper": "3f"}})}), LIMITS, LIMITS.lower)
