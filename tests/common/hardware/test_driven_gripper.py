"""Grippers behind a driver process, and the protocol of Robotiq."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest

from common.config import GripperConfig, load_cell
from common.control.gripper_controller import GripperController
from common.hardware import driver_process
from common.hardware.driven_gripper import DrivenGripper
from common.hardware.interface import HardwareFault
from common.messages import GripperCommand, GripperState
from drivers.robotiq import MODELS, Robotiq
from tests.doubles import robotiq
from tests.doubles.robotiq import RobotiqHost

TIMEOUT = 20.0
CONFIG: GripperConfig = load_cell("ur5", ["robot.gripper.speed=0.15"]).robot.gripper  # a 2F-85
TOUCH = 110  # [counts] at which the fingers meet the object,
WIDE = 0.085 * (228 - TOUCH) / 225  # [m] apart then


@pytest.fixture(autouse=True)
def _fast_gripper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robotiq, "SPEED", 2000.0)
    monkeypatch.setattr(driver_process, "FIRST_PAUSE", 0.05)


@pytest.fixture
def host() -> Iterator[RobotiqHost]:
    with RobotiqHost() as host:
        yield host


def connected(host: RobotiqHost) -> Robotiq:
    return Robotiq("127.0.0.1", MODELS["2f85"], 0.15, host.port)


class Driven:
    """The gripper behind its controller, cycle by cycle."""

    def __init__(self, host: RobotiqHost) -> None:
        options = {"host": "127.0.0.1", "port": host.port, "model": "2f85"}
        self.gripper = DrivenGripper("drivers.robotiq", options, CONFIG, name="a 2f85")
        self.controller, self.problem = GripperController(self.gripper, CONFIG), ""

    def until(self, condition: Callable[[GripperState], bool]) -> GripperState:
        end = time.monotonic() + TIMEOUT
        while True:
            now = time.monotonic()
            try:
                self.controller.update(self.gripper.read(now), now)
                self.problem = ""
            except HardwareFault as fault:
                self.problem = str(fault)
                self.controller.fault(self.problem)
            if condition(self.controller.state):
                return self.controller.state
            assert now < end, (self.controller.state, self.problem)
            time.sleep(0.01)

    def until_problem(self, text: str) -> None:
        self.until(lambda _: text in self.problem)

    def grip(self, name: str, width: float, **more: float) -> GripperState:
        """Return the final state of a command."""
        self.until(lambda _: not self.problem)
        self.controller.command(GripperCommand(id=name, width=width, **more), time.monotonic())
        return self.until(lambda state: state.state != "active")


def test_object_is_held_with_the_commanded_effort_and_released(host: RobotiqHost) -> None:
    driven, host.gripper.thing = Driven(host), TOUCH
    with closing(driven.gripper):
        state = driven.grip("close", 0.0, effort=100.0, expected_width=WIDE)
        assert (state.state, state.outcome, state.holding) == ("succeeded", "grasped", True)
        assert state.width == pytest.approx(WIDE, abs=3e-4) and state.effort == pytest.approx(100.0, abs=1.0)
        assert driven.grip("again", 0.0, expected_width=0.02).outcome == "too_wide"
        host.gripper.thing = None
        state = driven.grip("open", 0.08)
        assert (state.state, state.holding) == ("succeeded", False)


@pytest.mark.slow
def test_fault_or_loss_of_the_gripper_is_reported_until_it_is_connected_again() -> None:
    with RobotiqHost() as host:
        host.gripper.registers["STA"] = 0
        driven = Driven(host)
        driven.until_problem("a 2f85: the gripper is not activated (state 0)")
        with pytest.raises(HardwareFault, match="not activated"):
            driven.gripper.command(0.0, time.monotonic(), 20.0)
        host.gripper.registers["STA"] = 3
        driven.until(lambda _: not driven.problem)
        assert host.gripper.registers["GTO"] == 0
        assert driven.grip("first", 0.02).state == "succeeded"
    driven.until_problem("the gripper's program has closed the connection")
    driven.until_problem("refused")
    with RobotiqHost(host.port) as again, closing(driven.gripper):
        driven.until(lambda _: not driven.problem)
        assert again.gripper.registers["GTO"] == 0, "it does not repeat the command"


# --- the protocol, without a process ---


@pytest.mark.parametrize("answers", [b"ack", b"ack\n"])
def test_fingers_open_and_close_to_a_width(host: RobotiqHost, answers: bytes) -> None:
    host.gripper.answers = answers
    with closing(connected(host)) as gripper:
        for width in (0.03, 0.085, 0.0):
            gripper.move(width, 20.0)
            while (state := gripper.read()).moving:
                time.sleep(0.005)
            assert state.width == pytest.approx(width, abs=3e-4) and not state.holding  # a count



@pytest.mark.parametrize(("answer", "problem"), [
    (b"FLT 14\n", "the gripper has fault 14"), (b"FLT\n", "the gripper answers 'FLT'"),
    (b"FLT x\n", "the gripper answers 'FLT x'"), (b"?\n", "the gripper answers"), (b"y" * 600, "the gripper"),
])
def test_fault_or_invalid_answer_ends_the_driver_with_one_line(
    host: RobotiqHost, answer: bytes, problem: str, monkeypatch: pytest.MonkeyPatch,
) -> None:
    with closing(connected(host)) as gripper:
        monkeypatch.setattr(host.gripper, "answer", lambda line: answer)
        with pytest.raises((RuntimeError, ConnectionError), match=problem):
            gripper.read()
