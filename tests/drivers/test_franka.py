"""The backend of the Franka Research 3 with the vendor's library, against franka-sim."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import ruckig

from common.config import RobotConfig, load_cell
from common.control.gripper_controller import GripperController
from common.hardware.backends import load_hardware
from common.hardware.driven_gripper import DrivenGripper
from common.hardware.interface import HardwareFault, Limits
from common.messages import GripperCommand
from common.robot.model import RobotModel
from tests.doubles.franka_host import PYTHON, FrankaHost
from tests.drivers.driven_rig import PERIOD, SWING, TIMEOUT, Rig

pytestmark = [pytest.mark.slow, pytest.mark.alone, pytest.mark.timeout(120)]
if not PYTHON.exists():
    pytest.skip("make franka-sim", allow_module_level=True)
pytest.importorskip("pylibfranka", reason="make setup EXTRAS=franka")
in_real_time = pytest.mark.skipif(
    not os.environ.get("ZENCELL_TEST_FRANKA"), reason="ZENCELL_TEST_FRANKA=1: a host that simulates in real time")

SLOWER = 0.6
ROBOT: RobotConfig = load_cell("panda", ["robot=fr3", "robot.hardware.backend=franka",
                                         "robot.hardware.options.host=127.0.0.1"]).robot
MODEL = RobotModel.load(ROBOT)
LIMITS = Limits(
    tuple(MODEL.joint_names), MODEL.lower, MODEL.upper, MODEL.velocity, MODEL.acceleration, None, MODEL.jerk)


@contextmanager
def connected() -> Iterator[Rig]:
    options = {**ROBOT.hardware.options, "ahead": 0.1}
    hardware = ROBOT.hardware.model_copy(update={"options": options})
    rig = Rig(load_hardware(ROBOT.model_copy(update={"hardware": hardware}), LIMITS, np.zeros(7)), np.zeros(7))
    try:
        yield rig
    finally:
        rig.arm.gripper.close()
        rig.arm.close()


@pytest.fixture(scope="module")
def host() -> Iterator[FrankaHost]:
    with FrankaHost() as host:
        yield host


@pytest.fixture(scope="module")
def rig(host: FrankaHost) -> Iterator[Rig]:
    with connected() as rig:
        yield rig


def move(rig: Rig, target: np.ndarray, share: float = 1.0) -> str:
    """Move at a share of the limits, in the time of the simulated arm; return "" or why it ended early."""
    rig.until("")
    problem = ruckig.InputParameter(7)
    problem.current_position, problem.target_position = rig.measured.tolist(), target.tolist()
    problem.max_velocity, problem.max_acceleration, problem.max_jerk = (
        (share * limit).tolist() for limit in (MODEL.velocity, MODEL.acceleration, MODEL.jerk))
    trajectory = ruckig.Trajectory(7)
    ruckig.Ruckig(7).calculate(problem, trajectory)
    start = time.monotonic()
    while (now := time.monotonic()) < start + trajectory.duration / SLOWER + 1.0:
        q, dq, _ = trajectory.at_time(min(SLOWER * (now - start), trajectory.duration))
        if fault := rig.cycle(np.array(q), SLOWER * np.array(dq), now):
            return fault
    return ""


# --- tests with a host of their own: only one may run at a time ---


def test_hand_grasps_an_object_and_opens() -> None:
    config = ROBOT.gripper
    with FrankaHost("--gripper-physics", "--gripper-object-width", "0.06"):
        gripper = DrivenGripper("drivers.franka_hand", {"host": "127.0.0.1"}, config, name="hand")
        controller, end = GripperController(gripper, config), time.monotonic() + TIMEOUT
        for name, width, expected, outcome in (("close", 0.0, 0.06, "grasped"), ("open", 0.08, None, "")):
            state = None
            while state is None or state.state == "active":
                assert time.monotonic() < end, state
                now = time.monotonic()
                try:
                    state = controller.update(gripper.read(now), now)
                    if state.id != name:
                        state = controller.command(GripperCommand(id=name, width=width, expected_width=expected), now)
                except HardwareFault:
                    pass  # not connected yet
                time.sleep(PERIOD)
            assert (state.state, state.outcome) == ("succeeded", outcome), state
        gripper.close()


@in_real_time
def test_arm_accepts_motions_at_all_limits() -> None:
    with FrankaHost("--enforce-motion-limits", "--enforce-comm-constraints") as strict, connected() as rig:
        if move(rig, MODEL.named("home"), 0.3) or rig.arm.state.speed < 1.0:
            pytest.skip("this machine is too slow to simulate the arm: late set-points count as jumps")
        rng = np.random.default_rng(1)
        reach = 0.6 * (MODEL.upper - MODEL.lower) / 2
        for _ in range(6):
            target = (MODEL.upper + MODEL.lower) / 2 + rng.uniform(-reach, reach)
            assert move(rig, target) == "", strict.text[-2000:]
            assert np.abs(rig.arm.read(0.0)[0] - target).max() < 5e-3


def test_nothing_moves_without_a_request_and_motions_start_where_the_arm_is(host: FrankaHost, rig: Rig) -> None:
    rig.until("")
    assert rig.arm.state.mode == "running"
    assert np.allclose(rig.arm.read(0.0)[0], [0, 0, 0, -1.57, 0, 1.57, 0.785], atol=1e-3)
    assert move(rig, MODEL.named("home")) == "", host.text[-2000:]
    assert np.abs(rig.arm.read(0.0)[0] - MODEL.named("home")).max() < 5e-3


def test_arm_without_set_points_stops(rig: Rig) -> None:
    rig.until("")
    assert rig.swing(SWING / 4) == ""
    rig.wait_for(lambda: max(map(abs, rig.arm.state.dq)) < 1e-3)
    assert "ceased to come" in rig.until("ceased to come")
    rig.until_it_moves()
    assert rig.arm.state.mode == "running", "it had no reason to stop for protection"


def test_payload_is_set_at_rest_and_functions_of_desk_are_rejected_with_one_line(rig: Rig) -> None:
    rig.until("")
    assert rig.done(rig.arm.order("payload", 0.4, 0.0, 0.0, 0.05)) == ""
    assert "in Desk" in rig.done(rig.arm.order("enable"))
    assert "buttons" in rig.done(rig.arm.order("freedrive", 1.0))
    assert "cannot output" in rig.done(rig.arm.order("output", 1.0, 0.0))
    rig.until_it_moves()


def test_frozen_or_restarted_controller_is_connected_again_without_motion(host: FrankaHost, rig: Rig) -> None:
    rig.until("")
    host.freeze(1.0)
    rig.until_it_moves()
    host.crash()
    stopped_at = host.positions
    if rig.arm.state.mode == "running":
        rig.until("no message")
    host.boot()
    rig.until("")
    assert np.allclose(rig.arm.read(0.0)[0], stopped_at, atol=5e-3), "it has not moved"
