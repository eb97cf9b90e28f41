"""The estimate of the wrench at the tool: frames, payload, acceleration, zero and low-pass."""

import math

import numpy as np
import pytest

from common.config import PayloadConfig, load_cell
from common.control.force_sensing import NO_SENSOR, ForceSensing
from common.control.wrench import GRAVITY, Payload, WrenchEstimator, shifted, weight
from common.errors import Refused
from common.hardware.interface import HardwareFault
from common.hardware.mock import MockHardware
from common.messages import Header
from common.robot.model import RobotModel
from common.robot.tool_mass import described_tool
from common.robot.transforms import invert, rpy_to_matrix, transform

ROBOTS = {name: RobotModel.load(load_cell(name).robot) for name in ("panda", "ur5")}
ROBOT = ROBOTS["panda"]
LOAD = Payload(1.4, 0.01, -0.02, 0.09)
BIAS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
PERIOD = 0.01  # [s]


def random_q(seed: int, robot: RobotModel = ROBOT) -> np.ndarray:
    return np.random.default_rng(seed).uniform(robot.lower, robot.upper)


def reading(q: np.ndarray, load: Payload = LOAD, push: np.ndarray | None = None) -> np.ndarray:
    """Return what a sensor with a bias reads of a load at rest and of a force (3,) [N] in world on the TCP."""
    T = ROBOT.fk(q) @ invert(ROBOT.T_flange_tcp)
    total = weight(load, T[:3, :3].T @ [0, 0, -GRAVITY]) + BIAS
    if push is not None:
        force = T[:3, :3].T @ push
        total = total + np.concatenate([force, np.cross(ROBOT.T_flange_tcp[:3, 3], force)])
    return total


def zeroed(estimator: WrenchEstimator, q: np.ndarray) -> float:
    """Zero at q; return the time."""
    for cycle in range(22):
        estimator.update(cycle * PERIOD, reading(q), q, 0 * q, LOAD, at_rest=True)
    estimator.zero()
    return 21 * PERIOD


@pytest.mark.parametrize("seed", range(8))
def test_push_is_read_in_tool_axes_in_every_orientation_after_one_zero(seed: int) -> None:
    estimator, push = WrenchEstimator(ROBOT), np.array([3.0, -4.0, 12.0])
    now, q = zeroed(estimator, random_q(100)), random_q(seed)
    estimator.lose()
    found = estimator.update(now + PERIOD, reading(q, push=push), q, 0 * q, LOAD)
    assert found[:3] == pytest.approx(ROBOT.fk(q)[:3, :3].T @ push, abs=1e-9)
    assert found[3:] == pytest.approx([0, 0, 0], abs=1e-9), "it acts at the TCP"


@pytest.mark.parametrize("seed", range(4))
def test_shifting_there_and_back_changes_nothing_and_keeps_the_power(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = transform(rpy_to_matrix(*rng.normal(size=3)), rng.normal(size=3))
    wrench, twist = rng.normal(size=6), rng.normal(size=6)  # twist: velocity of the origin, then rate
    assert shifted(shifted(wrench, T), invert(T)) == pytest.approx(wrench)
    there = np.concatenate([T[:3, :3].T @ (twist[:3] + np.cross(twist[3:], T[:3, 3])), T[:3, :3].T @ twist[3:]])
    assert shifted(wrench, T) @ there == pytest.approx(wrench @ twist)


def test_acceleration_of_the_payload_is_no_force_unless_it_is_not_compensated() -> None:
    amplitude, speed = 0.2, 2.0  # [rad], [rad/s]
    most = {}
    for inertia in (True, False):
        most[inertia] = 0.0
        estimator = WrenchEstimator(ROBOT, bandwidth=500.0, inertia=inertia)
        for cycle in range(100):
            now = cycle * PERIOD
            q = ROBOT.named("home") + amplitude * math.sin(speed * now)
            dq = np.full(7, amplitude * speed * math.cos(speed * now))
            step = 1e-3
            at = [_com(ROBOT.named("home") + amplitude * math.sin(speed * (now - PERIOD / 2 + dt)))
                  for dt in (-step, 0.0, step)]
            acceleration = (at[0] - 2 * at[1] + at[2]) / step**2
            T = ROBOT.fk(q) @ invert(ROBOT.T_flange_tcp)
            raw = weight(LOAD, T[:3, :3].T @ (np.array([0, 0, -GRAVITY]) - acceleration))
            found = estimator.update(now, raw, q, dq, LOAD)
            if cycle:
                most[inertia] = max(most[inertia], float(np.linalg.norm(found[:3])))
    assert most[True] < 0.02 and most[False] > 0.5


def _com(q: np.ndarray) -> np.ndarray:
    T = ROBOT.fk(q) @ invert(ROBOT.T_flange_tcp)
    return T[:3, :3] @ LOAD.com + T[:3, 3]


@pytest.mark.parametrize("bandwidth", [1.0, 5.0])
def test_low_pass_has_the_stated_bandwidth(bandwidth: float) -> None:
    estimator, q, period, found = WrenchEstimator(ROBOT, bandwidth=bandwidth), random_q(1), 1e-3, []
    for cycle in range(round(8 / bandwidth / period)):
        raw = np.full(6, math.sin(2 * math.pi * bandwidth * cycle * period))
        found.append(estimator.update(cycle * period, raw, q, 0 * q)[:3])
    assert np.linalg.norm(found[len(found) // 2:], axis=1).max() == pytest.approx(math.sqrt(3) / math.sqrt(2), rel=0.03)


def test_zero_needs_rest_and_a_reading() -> None:
    estimator, q = WrenchEstimator(ROBOT), random_q(3)
    with pytest.raises(Refused, match="reports no force"):
        estimator.zero()
    for cycle in range(30):
        estimator.update(cycle * PERIOD, reading(q), q, 0 * q, LOAD, at_rest=cycle >= 20)
    with pytest.raises(Refused, match=r"must be at rest for 0.2 s, and is for 0.09 s"):
        estimator.zero()
    for cycle in range(30, 60):  # a payload that changes starts the wait again
        estimator.update(cycle * PERIOD, reading(q), q, 0 * q, LOAD if cycle < 50 else Payload(), at_rest=True)
    with pytest.raises(Refused, match="at rest"):
        estimator.zero()
    assert not estimator.zeroed


def test_payloads_add_and_subtract() -> None:
    held = Payload(0.5, 0.0, 0.0, 0.2)
    total = LOAD.with_other(held)
    assert total.mass == pytest.approx(1.9) and total.without(held) == pytest.approx(LOAD)
    assert total.without(total) == Payload()


def test_tool_of_the_description_is_known_only_where_all_its_links_have_a_mass() -> None:
    mass, com = described_tool(ROBOT)
    assert mass == pytest.approx(0.76) and com[2] == pytest.approx(0.0311, abs=1e-4)  # hand and two fingers
    assert described_tool(ROBOTS["ur5"]) is None
    assert [robot.flange_link for robot in ROBOTS.values()] == ["panda_link8", "tool0"]


class FakeSensor(MockHardware):
    """An arm at home whose sensor reads what the test sets."""

    known_payload: tuple[float, ...] | None = None
    reads: object = None

    def wrench(self) -> object:
        if isinstance(self.reads, Exception):
            raise self.reads
        return self.reads


def sensing(arm: MockHardware, payload: PayloadConfig | None = None, described: Payload | None = None) -> ForceSensing:
    gripper = ROBOT.config.gripper.model_copy(update={"payload": payload})
    return ForceSensing(arm, ROBOT, "tcp", gripper, described=described)


HOME = ROBOT.named("home")
CONFIGURED = PayloadConfig(mass=1.4, com=(0.01, -0.02, 0.09))


@pytest.mark.parametrize("payload, known, described, held, measured", [
    (CONFIGURED, None, Payload(9.0), 0.0, 1.4),
    (CONFIGURED, None, Payload(9.0), 0.5, 1.9),
    (None, None, Payload(0.76, 0, 0, 0.03), 0.5, 1.26),
    (None, None, None, 0.0, 0.0),
    (CONFIGURED, (1.4, 0.01, -0.02, 0.09), None, 0.0, 0.0),
    (CONFIGURED, (1.4, 0.01, -0.02, 0.09), None, 0.5, 0.5),
    (None, (2.0, 0.0, 0.0, 0.1), Payload(9.0), 0.0, 0.0),
    (None, (2.0, 0.0, 0.0, 0.1), None, 0.5, 0.5),
])
def test_payload_that_the_arm_does_not_subtract_is_subtracted(
    payload: PayloadConfig | None, known: tuple[float, ...] | None, described: Payload | None, held: float,
    measured: float,
) -> None:
    arm = FakeSensor(HOME, None)
    arm.known_payload, arm.reads = known, np.zeros(6)
    force = sensing(arm, payload, described)
    force.update(1.0, HOME, 0 * HOME, held, at_rest=True)
    up = ROBOT.fk(HOME)[:3, :3] @ force.estimator.wrench[:3]
    assert up == pytest.approx([0, 0, measured * GRAVITY], abs=1e-9)


@pytest.mark.parametrize("reads, reason", [
    (None, "reports no force"), (HardwareFault("the cable is out"), "the cable is out"),
])
def test_sensor_without_a_reading_gives_a_reason_and_no_zeros(reads: object, reason: str) -> None:
    arm = FakeSensor(HOME, None)
    force, arm.reads = sensing(arm), reads
    force.update(1.0, HOME, 0 * HOME, 0.0, at_rest=True)
    message = force.message(Header())
    assert reason in message.reason and message.force is None and message.torque is None
    with pytest.raises(Refused, match=reason):
        force.zero()


def test_arm_without_a_sensor_says_so_once_a_second() -> None:
    force, found = sensing(MockHardware(HOME, None)), []
    for cycle in range(250):
        force.update(cycle * PERIOD, HOME, 0 * HOME, 0.0, at_rest=True)
        found.append(force.due(Header(stamp=int(1e9 + cycle * 1e7))))
    sent = [message for message in found if message is not None]
    assert len(sent) == 3 and all(message.reason == NO_SENSOR and message.force is None for message in sent)
